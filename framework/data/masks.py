"""Masks of photographs: white where they are to be learnt from, black where they are not."""

from __future__ import annotations

from pathlib import Path

import imageio.v3 as iio
import numpy as np

from framework.base.errors import DataError
from framework.data.image_files import Content, unreadable

THRESHOLD = 128
"""The least grey that counts as white."""


def read_mask(path: Path, width: int, height: int) -> np.ndarray:
    """Which pixels of a photograph of width x height are to be used, (H, W) bool.

    A mask may be larger or smaller than its photograph by a whole number, but for the rest that is cut off when images
    are reduced; then a pixel has the value of the nearest.

    Raises: DataError that names the file, where it is missing, unreadable or of another size.
    """
    if not path.is_file():
        raise DataError(f"the mask {path} does not exist")
    try:
        grey = np.asarray(iio.imread(Content(path), plugin="pillow", mode="L", index=0))
    except Exception as error:  # as in `read_image`
        raise unreadable(path, error, "the mask") from error
    if not grey.size:
        raise DataError(f"the mask {path} has no pixel")
    used = grey >= THRESHOLD
    down, up = round(used.shape[1] / width), round(width / used.shape[1])
    if _times(used.shape, (height, width), down):
        places = [np.arange(n) * down + down // 2 for n in (height, width)]
    elif _times((height, width), used.shape, up):
        places = [np.arange(n) // up for n in (height, width)]
    else:
        raise DataError(
            f"the mask {path} is {used.shape[1]}x{used.shape[0]} pixels, but its photograph is {width}x{height}; "
            "the one must be a whole number of times the other"
        )
    rows, columns = (np.minimum(at, size - 1) for at, size in zip(places, used.shape, strict=True))
    return used[np.ix_(rows, columns)]


def _times(large: tuple[int, ...], small: tuple[int, ...], factor: int) -> bool:
    """Whether a size is `factor` times another, but for a rest."""
    return all(abs(a - b * factor) < factor for a, b in zip(large, small, strict=True))
