"""Detection of cameras that only rotated: without parallax, distances are unknown."""

from __future__ import annotations

import numpy as np

WITHOUT = 0.8
"""A capture has no parallax if a rotation explains more than this fraction of pairs. In two panoramas a rotation
explained 99 % and 100 % of the pairs; in two captures by a walking person, 5 % and 8 %."""
MAX_RESIDUAL = 0.003
"""Maximum median distance of matches after a rotation that explains them, as a fraction of the image's longer side."""
MIN_MOTION = 0.02
"""Minimum median motion of matches for a pair to count, as a fraction of the longer side."""
FOCALS = np.geomspace(0.3, 5.0, 25)
"""Focal lengths tried, in units of the image's longer side."""
MAX_PAIRS = 100
"""Maximum number of pairs examined."""
NO_PARALLAX = (
    "the photographs have no parallax, as if the camera had turned on the spot (a panorama). Distances are unknown "
    "and poses are meaningless: take photographs from different positions, with a step to the side each"
)
"""Message about such a capture, with advice."""


def share_that_turned(pairs: list[tuple[np.ndarray, np.ndarray]]) -> float:
    """Return the fraction of pairs with matches that a camera rotation alone explains, with one focal length.

    The focal length that explains most pairs is used. Pairs with little motion are left out.

    Args:
        pairs: matches of each pair, as positions (M, 2) in units of the image's longer side from its centre.

    Returns:
        The fraction, from 0 to 1; 0 if no pair counts.
    """
    telling = [(one, two) for one, two in pairs if np.median(np.linalg.norm(one - two, axis=1)) > MIN_MOTION]
    if not telling:
        return 0.0
    shares = [np.mean([left_by_rotation(*pair, focal) <= MAX_RESIDUAL for pair in telling]) for focal in FOCALS]
    return float(max(shares))


def left_by_rotation(first: np.ndarray, second: np.ndarray, focal: float) -> float:
    """Return the median distance of matches after the best rotation of their rays (Wahba's problem, by SVD).

    Args:
        first: (M, 2) positions in one image, in units of the longer side from its centre.
        second: (M, 2) positions in the other.
        focal: focal length in the same units.
    """
    one, two = (np.concatenate([points, np.full((len(points), 1), focal)], axis=1) for points in (first, second))
    rays = [points / np.linalg.norm(points, axis=1, keepdims=True) for points in (one, two)]
    u, _, vt = np.linalg.svd(rays[1].T @ rays[0])
    turned = rays[0] @ (u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt).T
    ahead = np.maximum(turned[:, 2:], 1e-9)
    return float(np.median(np.linalg.norm(turned[:, :2] / ahead * focal - second, axis=1)))
