"""A few of a data set's training images, to see what a method learns from few."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

import torch

from nerfloom.base.errors import ConfigError
from nerfloom.data.dataset import ParsedScene


def evenly_spread(total: int, count: int) -> list[int]:
    """Return the numbers of `count` of `total` images, the first and the last among them, at equal distances.

    A number that is no integer is rounded, from the middle between two to the even one, as RegNeRF (Niemeyer et al.
    2022) and FreeNeRF (Yang et al. 2023) choose 3, 6 or 9 of the training images of a capture.

    Args:
        total: number of images, 1 or more.
        count: number of images to choose, 1 or more; all if it is more than `total`.
    """
    if count >= total:
        return list(range(total))
    return [round(Fraction(rank * (total - 1), max(count - 1, 1))) for rank in range(count)]


def chosen_images(parsed: ParsedScene, most: int | None, indices: Sequence[int]) -> ParsedScene:
    """Return a scene with some of its images; everything else, such as its placement, stays that of all images.

    Args:
        parsed: the images of the training split, in the order of the data format.
        most: number of images, evenly spread; None for all.
        indices: numbers of the images, counted from 0, instead of a number of them; empty for all.

    Raises:
        ConfigError: if both are given, or an index is given twice or has no image.
    """
    total = len(parsed.image_paths)
    if indices and most is not None:
        raise ConfigError("--train-image-indices already says how many images: leave out --max-train-images")
    if len(set(indices)) < len(indices) or not all(0 <= index < total for index in indices):
        raise ConfigError(
            f"--train-image-indices {' '.join(map(str, indices))}: each must be from 0 to {total - 1}, and given once"
        )
    if not indices and (most is None or most >= total):
        return parsed
    return parsed[torch.tensor(list(indices) or evenly_spread(total, most or total))]
