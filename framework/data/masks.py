"""Masks of images: white for pixels to train on, black for others."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from nerfloom.base.errors import DataError
from nerfloom.data.image_files import Content, or_unreadable

THRESHOLD = 128
"""Minimum grey value that counts as white."""


def read_mask(path: Path, width: int, height: int) -> np.ndarray:
    """Read the mask of an image.

    The mask may be larger or smaller than the image by an integer factor, apart from the remainder that is cut off when
    images are reduced. Each pixel takes the nearest value.

    Args:
        path: the mask's file.
        width, height: size of the image, pixels.

    Returns:
        (H, W) bool, True for pixels to train on.

    Raises:
        DataError: if the file is missing, unreadable or has another size.
    """
    used = read_white(path)
    down, up = round(used.shape[1] / width), round(width / used.shape[1])
    if _is_multiple(used.shape, (height, width), down):
        indices = [np.arange(n) * down + down // 2 for n in (height, width)]
    elif _is_multiple((height, width), used.shape, up):
        indices = [np.arange(n) // up for n in (height, width)]
    else:
        raise DataError(
            f"the mask {path} is {used.shape[1]}x{used.shape[0]} pixels, but its image is {width}x{height}; "
            "one size must be an integer multiple of the other"
        )
    rows, columns = (np.minimum(index, size - 1) for index, size in zip(indices, used.shape, strict=True))
    return used[np.ix_(rows, columns)]


def read_white(path: Path) -> np.ndarray:
    """Return which pixels of the mask in a file are white, (H, W) bool.

    A transparent pixel is not white. A mask of the values 0 and 1, as some programs write it, is black and white.

    Raises:
        DataError: if the file is missing or unreadable.
    """
    if not path.is_file():
        raise DataError(f"the mask {path} does not exist")
    grey = or_unreadable(path, "the mask", lambda: _over_black(Content(path)))
    if not grey.size:
        raise DataError(f"the mask {path} has no pixels")
    return grey >= (1 if grey.max() == 1 else THRESHOLD)


def _over_black(content: Content) -> np.ndarray:
    """Return the brightness (H, W) uint8 of an image of any mode before a black background."""
    with Image.open(content) as image:
        if "A" not in image.getbands() and "transparency" not in image.info:
            return np.asarray(image.convert("L"))
        black = Image.new("RGBA", image.size, "black")
        return np.asarray(Image.alpha_composite(black, image.convert("RGBA")).convert("L"))


def _is_multiple(large: tuple[int, ...], small: tuple[int, ...], factor: int) -> bool:
    """Return whether a size is `factor` times another, up to a remainder."""
    return all(abs(a - b * factor) < factor for a, b in zip(large, small, strict=True))
