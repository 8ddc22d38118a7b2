"""Selection of few training images, to test how a method learns from few."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import torch

from nerfloom.base.errors import ConfigError
from nerfloom.base.evenly_spaced import evenly_spread
from nerfloom.data.parsed_scene import ParsedScene


def chosen_images(parsed: ParsedScene, most: int | None, indices: Sequence[int]) -> ParsedScene:
    """Return a scene with some of its images; all else, such as the placement, still comes from all images.

    Args:
        parsed: the images of the training split, in the order of the data format.
        most: maximum number of images, evenly spread; None for all.
        indices: indices of the images, counted from 0, instead of a number of images; empty for all.

    Raises:
        ConfigError: if both are given, or if an index is repeated or out of range.
    """
    total = len(parsed.image_paths)
    if indices and most is not None:
        raise ConfigError("--train-image-indices already selects images: leave out --max-train-images")
    wrong = next((index for index, times in Counter(indices).items() if times > 1 or not 0 <= index < total), None)
    if wrong is not None:
        raise ConfigError(f"--train-image-indices: {wrong} must be from 0 to {total - 1} and be given once")
    if not indices and (most is None or most >= total):
        return parsed
    return parsed[torch.tensor(list(indices) or evenly_spread(total, most or total))]
