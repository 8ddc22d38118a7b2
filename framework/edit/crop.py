"""Crops: the Gaussians in a part of space, or of a photograph, are kept or removed."""

from __future__ import annotations

from pathlib import Path

import torch

from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.outline import outlined
from nerfloom.data.masks import read_mask
from nerfloom.edit.edited import Edited
from nerfloom.geometry.regions import Box, Place, Region, Sphere, Vector, read_regions


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
    """Keep the Gaussians with centres in all regions of a file.

    Args:
        file: boxes, spheres and polygons (`nerfloom.geometry.regions`).
        keep: False to remove them instead.

    Raises:
        ConfigError: if the file holds no region.
    """
    inside = torch.ones(len(edited), dtype=torch.bool)
    for region in read_regions(file):
        inside &= region.contains(edited.gaussians.means)
    return edited.kept(inside == keep)


def crop_polygon(edited: Edited, image: str, corners: tuple[Place, ...], keep: bool = True) -> Edited:
    """Keep the Gaussians with centres that a photograph shows in a polygon, at any distance.

    Args:
        image: file name of the photograph.
        corners: column and row of each corner; (0, 0) is the centre of the top left pixel.
        keep: False to remove them instead.

    Raises:
        ConfigError: if there are fewer than three corners, or no such photograph.
    """
    polygon = outlined(_camera(edited, image), corners)
    return _cropped_to(edited, polygon.moved(*edited.placement.original_similarity()), keep)


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
    height, width = camera.sizes[0]
    white = torch.from_numpy(read_mask(mask, width, height))
    columns, rows, ahead = camera.project(edited.placement.points(edited.gaussians.means), 0)
    shown = ahead & (columns >= -0.5) & (columns < width - 0.5) & (rows >= -0.5) & (rows < height - 0.5)
    column, row = columns.round().long().clamp(0, width - 1), rows.round().long().clamp(0, height - 1)
    return edited.kept((shown & white[row, column]) == keep)


def _cropped_to(edited: Edited, region: Region, keep: bool) -> Edited:
    return edited.kept(region.contains(edited.gaussians.means) == keep)


def _camera(edited: Edited, image: str) -> Cameras:
    """Return the camera of a photograph, float64, on the CPU."""
    return edited.photographed(f"the image {image}").photograph(image).camera.to("cpu").in_float64()
