"""Crops: the Gaussians in a part of space, or of a photograph, are kept or removed."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from nerfloom.base.errors import ConfigError
from nerfloom.cameras.cameras import Cameras
from nerfloom.data.masks import read_mask
from nerfloom.edit.edited import Edited
from nerfloom.geometry.regions import Box, Region, Sphere, Vector, read_region

Pixel = tuple[float, float]
"""Column and row; (0, 0) is the centre of the top left pixel."""


def crop_box(edited: Edited, low: Vector, high: Vector, keep: bool = True) -> Edited:
    """Keep the Gaussians with centres in a box.

    Args:
        low: minimum corner.
        high: maximum corner.
        keep: False to remove them instead.

    Raises:
        ConfigError: if the box is empty.
    """
    return _cropped_to(edited, Box(low, high), keep)


def crop_sphere(edited: Edited, center: Vector, radius: float, keep: bool = True) -> Edited:
    """Keep the Gaussians with centres in a ball.

    Args:
        center: its centre.
        radius: its radius.
        keep: False to remove them instead.

    Raises:
        ConfigError: if the radius is not positive.
    """
    return _cropped_to(edited, Sphere(center, radius), keep)


def crop_region(edited: Edited, file: Path, keep: bool = True) -> Edited:
    """Keep the Gaussians with centres in the region of a file.

    Args:
        file: a box or a sphere (`nerfloom.geometry.regions`).
        keep: False to remove them instead.

    Raises:
        ConfigError: if the file holds no region.
    """
    return _cropped_to(edited, read_region(file), keep)


def crop_polygon(edited: Edited, image: str, corners: tuple[Pixel, ...], keep: bool = True) -> Edited:
    """Keep the Gaussians with centres that a photograph shows in a polygon, at any distance.

    Args:
        image: file name of the photograph.
        corners: column and row of each corner; (0, 0) is the centre of the top left pixel.
        keep: False to remove them instead.

    Raises:
        ConfigError: if there are fewer than three corners, or no such photograph.
    """
    if len(corners) < 3:
        raise ConfigError(f"a polygon has at least 3 corners, not {len(corners)}")
    columns, rows, shown = in_image(edited, _camera(edited, image))
    return edited.kept((shown & inside_polygon(columns, rows, corners)) == keep)


def crop_mask(edited: Edited, image: str, mask: Path, keep: bool = True) -> Edited:
    """Keep the Gaussians with centres that a photograph shows where a mask is white, at any distance.

    Args:
        image: file name of the photograph.
        mask: image file of the photograph's size, or of an integer multiple or fraction of it.
        keep: False to remove them instead.

    Raises:
        ConfigError: if there is no such photograph.
        DataError: if the mask cannot be read, or has another size.
    """
    camera = _camera(edited, image)
    columns, rows, shown = in_image(edited, camera)
    height, width = camera.sizes[0]
    white = torch.from_numpy(read_mask(mask, width, height))
    column, row = columns.round().long().clamp(0, width - 1), rows.round().long().clamp(0, height - 1)
    return edited.kept((shown & white[row, column]) == keep)


def in_image(edited: Edited, camera: Cameras) -> tuple[Tensor, Tensor, Tensor]:
    """Return where an image shows centres: columns and rows (N,), and (N,) bool, whether it shows them.

    Args:
        camera: one camera in the scene of `edited.loaded`, float64, on the CPU.
    """
    columns, rows, ahead = camera.project(edited.placement.points(edited.gaussians.means), 0)
    height, width = camera.sizes[0]
    shown = ahead & (columns >= -0.5) & (columns < width - 0.5) & (rows >= -0.5) & (rows < height - 0.5)
    return columns, rows, shown


def inside_polygon(columns: Tensor, rows: Tensor, corners: tuple[Pixel, ...]) -> Tensor:
    """Return which positions are inside a polygon, (N,) bool, by the number of edges to their right (even-odd rule).

    Args:
        columns, rows: (N,) positions.
        corners: column and row of each corner, in order.
    """
    inside = torch.zeros_like(columns, dtype=torch.bool)
    for (x0, y0), (x1, y1) in zip(corners, (*corners[1:], corners[0]), strict=True):
        if y0 != y1:
            crosses = (y0 > rows) != (y1 > rows)
            inside ^= crosses & (columns < x0 + (x1 - x0) * (rows - y0) / (y1 - y0))
    return inside


def _cropped_to(edited: Edited, region: Region, keep: bool) -> Edited:
    return edited.kept(region.contains(edited.gaussians.means) == keep)


def _camera(edited: Edited, image: str) -> Cameras:
    """Return the camera of a photograph, float64, on the CPU."""
    return edited.photographed(f"the image {image}").photograph(image).camera.to("cpu").in_float64()
