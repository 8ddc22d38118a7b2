"""Diffuse light of image content without reflections, as the procedural shiny scenes store it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from nerfloom.base.errors import DataError
from nerfloom.data.depths import check_pixels, nearest_pixels
from nerfloom.data.image_files import or_unreadable

ENDING = "_light.npz"
"""End of the name of a file of light, after the name of its image without the suffix."""
NAME = "diffuse"
"""Name of the array of diffuse light in the file."""


def read_diffuse(path: Path, width: int, height: int) -> Tensor:
    """Read the diffuse light of an image.

    Each pixel takes the nearest value.

    Args:
        path: a file of NumPy arrays with `diffuse`, (H, W, 3) linear light of at least 0; 0 beside the object.
        width, height: size of the image, pixels.

    Returns:
        (H, W, 3) float32 linear light.

    Raises:
        DataError: if the file is unreadable, has no such array, or its array is not of plausible size.
    """
    what = "the file of light"
    stored = or_unreadable(path, what, lambda: _array(path))
    if stored.ndim != 3 or stored.shape[2] != 3 or stored.dtype != np.float32:
        raise DataError(f"{what} {path} must have {NAME}, an array (height, width, 3) of float32")
    check_pixels(f"{what} {path}", stored.shape, width, height)
    if not bool(np.isfinite(stored).all()) or bool((stored < 0).any()):
        raise DataError(f"{what} {path} has diffuse light that is negative or not finite")
    return torch.from_numpy(stored[nearest_pixels(stored.shape, width, height)])


def _array(path: Path) -> np.ndarray:
    with np.load(path, allow_pickle=False) as content:
        found: np.ndarray = content[NAME]
        return found
