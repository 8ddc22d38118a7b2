"""Depth images: measured distances of image content."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

import imageio.v3 as iio
import numpy as np
import torch
from torch import Tensor

from nerfloom.base.arrays import read_array
from nerfloom.base.errors import DataError
from nerfloom.cameras.cameras import Cameras
from nerfloom.data.exr import depth_channel, read_channel, read_header
from nerfloom.data.image_files import Content, or_unreadable
from nerfloom.data.suffixes import IMAGE_SUFFIXES

T = TypeVar("T")

DEPTH_SUFFIXES = (*IMAGE_SUFFIXES, ".npy", ".exr")
"""Suffixes of depth images, in lower case."""
MAX_PIXELS = 64
"""Maximum number of depth pixels per image pixel; usually there is less than one."""


def read_depth(path: Path, width: int, height: int) -> np.ndarray:
    """Read the depth image of an image, in its own unit.

    Each pixel takes the nearest value, because depths must not be interpolated across edges.

    Args:
        path: a .npy file, an OpenEXR file (`exr.py`), or an image file.
        width, height: size of the image, pixels.

    Returns:
        (H, W) float32.

    Raises:
        DataError: if the file is missing, unreadable, or not a single channel of plausible size.
    """
    if not path.is_file():
        raise DataError(f"the depth image {path} does not exist")
    stored = _read(path, read_array) if path.suffix.lower() == ".npy" else None
    if stored is not None and stored.shape[2:] == (1,):
        stored = stored[..., 0]  # as networks return it
    is_exr = path.suffix.lower() == ".exr"
    shape = _read(path, _exr_shape if is_exr else _shape) if stored is None else stored.shape
    if len(shape) != 2 or 0 in shape:
        raise DataError(f"the depth image {path} has shape {shape}; it must be (height, width)")
    check_pixels(f"the depth image {path}", shape, width, height)
    values = _read(path, _exr_values if is_exr else _values) if stored is None else stored
    return _read(path, lambda _: values[nearest_pixels(shape, width, height)].astype(np.float32))


def check_pixels(what: str, shape: Sequence[int], width: int, height: int) -> None:
    """Check, before memory is allocated, the `shape` of the image `what` of an image of `width` x `height` pixels.

    Raises:
        DataError: if it has more than `MAX_PIXELS` times as many pixels.
    """
    if shape[0] * shape[1] > MAX_PIXELS * width * height:
        raise DataError(
            f"{what} has {shape[1]} x {shape[0]} pixels, its image {width} x {height}; "
            f"the limit is {MAX_PIXELS} times as many pixels"
        )


def nearest_pixels(shape: Sequence[int], width: int, height: int) -> tuple[np.ndarray, ...]:
    """Return the rows (H, 1) and columns (1, W) of an image of `shape` nearest to the pixels of `width` x `height`."""
    rows, columns = (
        np.minimum((np.arange(count) + 0.5) * size / count, size - 1).astype(np.int64)
        for count, size in zip((height, width), shape[:2], strict=True)
    )
    return np.ix_(rows, columns)


def _shape(path: Path) -> tuple[int, ...]:
    """Return the shape stated in an image's header."""
    return iio.improps(path, plugin="pillow", index=0).shape


def _values(path: Path) -> np.ndarray:
    """Return the pixels of an image, or of its first frame."""
    return np.asarray(iio.imread(Content(path), plugin="pillow", index=0))


def _exr_shape(path: Path) -> tuple[int, ...]:
    return read_header(Content(path).getvalue()).shape


def _exr_values(path: Path) -> np.ndarray:
    content = Content(path).getvalue()
    header = read_header(content)
    return read_channel(content, header, depth_channel(header))


def _read(path: Path, read: Callable[[Path], T]) -> T:
    return or_unreadable(path, "the depth image", lambda: read(path))


def read_depths(paths: Sequence[Path | None], cameras: Cameras, unit: float) -> Tensor:
    """Read the depths of all pixels of all cameras.

    Args:
        paths: M files; None for an image without depth.
        cameras: M cameras, for the sizes of the decoded images.
        unit: scene units per unit of a stored depth.

    Returns:
        (P,) float16 depths along the cameras' axes, scene units, 0 where unknown. float16 has a relative precision of
        1/2000, better than depth cameras.
    """
    parts = []
    for path, width, height in zip(paths, cameras.widths.tolist(), cameras.heights.tolist(), strict=True):
        depth = np.zeros((height, width), np.float32) if path is None else read_depth(path, width, height) * unit
        with np.errstate(over="ignore"):
            depth = depth.astype(np.float16)  # depths out of range become infinite, which counts as unknown
        parts.append(torch.from_numpy(np.where(np.isfinite(depth) & (depth > 0), depth, 0).reshape(-1)))
    return torch.cat(parts)


def ray_distances(depths: Tensor, directions: Tensor, poses: Tensor) -> Tensor:
    """Convert depths along the camera's axis to distances along rays.

    Args:
        depths: (R,) depths, 0 where unknown.
        directions: (R, 3) unit directions.
        poses: (R, 3, 4) camera-to-world, OpenGL axes: the third column points backwards along the axis.

    Returns:
        (R,) distances, 0 where unknown.
    """
    cosines = -(directions * poses[:, :, 2]).sum(-1)
    return torch.where(cosines > 1e-3, depths.float() / cosines.clamp(min=1e-3), torch.zeros_like(cosines))
