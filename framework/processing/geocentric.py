"""Geocentric coordinates: metres from the centre of the Earth, x to longitude 0, z to the north pole (WGS 84)."""

from __future__ import annotations

import numpy as np

EQUATOR, POLE = 6378137.0, 6356752.314245
"""Semi-axes of the ellipsoid of WGS 84, metres (NIMA TR8350.2)."""
MAX_HEIGHT = 100e3
"""Maximum distance from the surface that counts as being near it, metres."""


def is_near_surface(position: np.ndarray) -> bool:
    """Return whether a `position` (3,) may be geocentric: on the Earth, below it or in its air."""
    return POLE - MAX_HEIGHT < float(np.linalg.norm(position)) < EQUATOR + MAX_HEIGHT


def east_north_up(position: np.ndarray) -> np.ndarray:
    """Return the rotation (3, 3) from geocentric axes to local axes at a place: x east, y north, z up.

    Up is the normal of the ellipsoid through the position, which differs from the plumb line's by arc seconds.

    Args:
        position: (3,) geocentric, metres.
    """
    up = position / np.array([EQUATOR, EQUATOR, POLE]) ** 2
    up /= np.linalg.norm(up)
    east = np.array([-up[1], up[0], 0.0])
    length = np.linalg.norm(east)
    east = np.array([0.0, 1.0, 0.0]) if length < 1e-12 else east / length  # at a pole, along longitude 0
    return np.stack([east, np.cross(up, east), up])
