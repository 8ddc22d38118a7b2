"""Depth images: how far away what a photograph shows was measured to be."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

import imageio.v3 as iio
import numpy as np
import torch
from torch import Tensor

from framework.base.arrays import read_array
from framework.base.errors import DataError
from framework.cameras.cameras import Cameras
from framework.data.image_files import Content, unreadable

T = TypeVar("T")

MOST_PIXELS = 64
"""Of a depth image, for each of its photograph's; most have fewer than that."""


def read_depth(path: Path, width: int, height: int) -> np.ndarray:
    """A depth image as (H, W) float32 in its own steps, for a photograph of width x height.

    Each pixel takes the nearest of the depth image's, which is mostly smaller: depths are never mixed.

    Raises: DataError that names the file, where it is missing, unreadable or has several channels.
    """
    if not path.is_file():
        raise DataError(f"the depth image {path} does not exist")
    stored = _or_refused(path, read_array) if path.suffix == ".npy" else None
    shape = _or_refused(path, _shape) if stored is None else stored.shape
    if len(shape) != 2 or 0 in shape:
        raise DataError(f"the depth image {path} has the shape {shape}; it must have rows and columns alone")
    if shape[0] * shape[1] > MOST_PIXELS * width * height:  # before memory for them is asked for
        raise DataError(
            f"the depth image {path} has {shape[1]} x {shape[0]} pixels for a photograph of {width} x {height}; "
            f"more than {MOST_PIXELS} times as many are not believed"
        )
    rows, columns = (
        np.minimum((np.arange(count) + 0.5) * size / count, size - 1).astype(np.int64)
        for count, size in zip((height, width), shape, strict=True)
    )
    values = _or_refused(path, _values) if stored is None else stored
    return _or_refused(path, lambda _: values[np.ix_(rows, columns)].astype(np.float32))


def _shape(path: Path) -> tuple[int, ...]:
    """What a picture's head says."""
    return iio.improps(path, plugin="pillow", index=0).shape


def _values(path: Path) -> np.ndarray:
    """A picture's, the first of several."""
    return np.asarray(iio.imread(Content(path), plugin="pillow", index=0))


def _or_refused(path: Path, read: Callable[[Path], T]) -> T:
    try:
        return read(path)
    except Exception as error:  # as in `read_image`
        raise unreadable(path, error, "the depth image") from error


def read_depths(paths: Sequence[Path | None], cameras: Cameras, unit: float) -> Tensor:
    """(P,) float16 depths along the cameras' axes of all their pixels, scene units; 0 where unknown.

    float16 tells depths apart to a two thousandth, which no depth camera does.

    Args:
        paths: M depth images.
        cameras: M cameras at the photographs' size.
        unit: scene units that a step of a depth image stands for.
    """
    parts = []
    for path, width, height in zip(paths, cameras.widths.tolist(), cameras.heights.tolist(), strict=True):
        depth = np.zeros((height, width), np.float32) if path is None else read_depth(path, width, height) * unit
        with np.errstate(over="ignore"):
            depth = depth.astype(np.float16)  # what is too far for it becomes infinite, and so is unknown
        parts.append(torch.from_numpy(np.where(np.isfinite(depth) & (depth > 0), depth, 0).reshape(-1)))
    return torch.cat(parts)


def ray_distances(depths: Tensor, directions: Tensor, poses: Tensor) -> Tensor:
    """Distances (R,) along rays of depths (R,) along their cameras' axes; 0 where unknown.

    Args:
        directions: (R, 3) unit.
        poses: (R, 3, 4) camera-to-world, OpenGL axes: the axis is the third column, backwards.
    """
    cosines = -(directions * poses[:, :, 2]).sum(-1)
    return torch.where(cosines > 1e-3, depths.float() / cosines.clamp(min=1e-3), torch.zeros_like(cosines))
