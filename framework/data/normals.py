"""Normal images: the true normals of image content, as Shiny Blender (Verbin et al. 2022) stores them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import torch
from torch import Tensor

from nerfloom.base.errors import DataError
from nerfloom.data.depths import check_pixels, nearest_pixels
from nerfloom.data.image_files import Content, or_unreadable

ENDING = "_normal.png"
"""End of a normal image's name, after the name of its image without the suffix."""


def files_beside(images: Sequence[Path], ending: str) -> tuple[Path | None, ...] | None:
    """Return the file with an `ending` after its name beside each of `images`, or None; None if no image has one."""
    found = tuple(path.with_name(path.stem + ending) for path in images)
    known = tuple(path if path.is_file() else None for path in found)
    return known if any(known) else None


def read_normals(path: Path, width: int, height: int) -> Tensor:
    """Read the normal image of an image.

    Each pixel takes the nearest value, because normals must not be interpolated across edges.

    Args:
        path: an image with (normal + 1) / 2 as red, green and blue.
        width, height: size of the image, pixels.

    Returns:
        (H, W, 3) float32 unit vectors in the axes of the input.

    Raises:
        DataError: if the file is unreadable, not of 8-bit colours, or not of plausible size.
    """
    what = "the normal image"
    shape = or_unreadable(path, what, lambda: iio.improps(path, plugin="pillow", index=0).shape)
    check_pixels(f"{what} {path}", shape, width, height)
    stored = or_unreadable(path, what, lambda: np.asarray(iio.imread(Content(path), plugin="pillow", index=0)))
    if stored.ndim != 3 or stored.shape[2] < 3 or stored.dtype != np.uint8:
        raise DataError(f"the normal image {path} must have red, green and blue of 8 bits")
    nearest = stored[nearest_pixels(stored.shape, width, height)]
    values = torch.from_numpy(nearest[..., :3].astype(np.float32)) / 127.5 - 1
    return torch.nn.functional.normalize(values, dim=-1)
