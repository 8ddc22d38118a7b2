"""Diffuse light of image content without reflections, as the procedural shiny scenes store it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from nerfloom.base.archives import uncompressed_size
from nerfloom.base.errors import DataError
from nerfloom.data.depths import MAX_PIXELS, check_pixels, nearest_pixels

ENDING = "_light.npz"
"""End of the name of a file of light, after the name of its image without the suffix."""
NAME = "diffuse"
"""Name of the array of diffuse light in the file."""
MAX_BYTES = 64
"""Maximum number of bytes per pixel, of all arrays together."""


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
    stored = _array(path, MAX_BYTES * MAX_PIXELS * width * height)
    if stored.ndim != 3 or stored.shape[2] != 3 or stored.dtype != np.float32:
        raise DataError(f"{what} {path} must have {NAME}, an array (height, width, 3) of float32")
    check_pixels(f"{what} {path}", stored.shape, width, height)
    if not bool(np.isfinite(stored).all()) or bool((stored < 0).any()):
        raise DataError(f"{what} {path} has diffuse light that is negative or not finite")
    return torch.from_numpy(stored[nearest_pixels(stored.shape, width, height)])


def _array(path: Path, limit: int) -> np.ndarray:
    """Return the array of a file with at most `limit` bytes, uncompressed."""
    try:
        if uncompressed_size(path) > limit:
            raise ValueError("it is too large for its image")
        with np.load(path, allow_pickle=False) as content:
            found: np.ndarray = content[NAME]
            return found
    except OSError as error:
        raise DataError(f"cannot read {path}: {error.strerror or error}") from error
    except Exception as error:  # numpy, zipfile and zlib raise ValueError, EOFError, BadZipFile, zlib.error and more
        because = " ".join(str(error).split())[:200] or type(error).__name__
        raise DataError(f"{path} is damaged, or no file of light: {because}; copy it again or remove it") from error
