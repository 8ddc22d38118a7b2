"""Outlines drawn on a picture, as regions of space."""

from __future__ import annotations

from collections.abc import Sequence

from nerfloom.cameras.cameras import Cameras
from nerfloom.geometry.regions import Place, Polygon, axes_of


def outlined(camera: Cameras, corners: Sequence[Place], keep: bool = True) -> Polygon:
    """Return what a camera shows in a polygon on its picture, at any distance.

    Args:
        camera: one camera; the region is in its frame and unit.
        corners: column and row of each corner, in order; (0, 0) is the centre of the top left pixel.
        keep: False for the rest.

    Raises:
        ConfigError: if there are fewer than three corners.
    """
    exact = camera.to("cpu").in_float64()
    pose, (fx, fy, cx, cy) = exact.camera_to_worlds[0], exact.intrinsics[0]
    x, y, z = pose[:, 3].tolist()
    places = tuple(((column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy) for column, row in corners)
    lens = () if exact.lens is None else tuple(exact.lens[0].tolist())
    return Polygon((x, y, z), axes_of(pose[:, :3].T), places, keep, camera.model, lens)
