"""Data sets of a run, by split."""

from __future__ import annotations

import torch

from nerfloom.base.console import say
from nerfloom.base.errors import DataError
from nerfloom.base.evenly_spaced import strided
from nerfloom.base.splits import Split
from nerfloom.data.dataset import Dataset, load_dataset
from nerfloom.data.pixels.cache import PixelMemory
from nerfloom.training.run import Run


def load_split(run: Run, split: Split, most: int | None = None) -> Dataset:
    """Parse and decode a split of a run's data.

    Args:
        run: the run, with the data's folder and format and the limit of pixels in memory.
        split: part of the data set.
        most: maximum number of images, evenly spaced; None for all. No effect on data with images at several scales or
            with source images.

    Raises:
        DataError: if the data is missing or cannot be read.
    """
    memory = PixelMemory.of(run.config.cache_limit, run.config.cache_dir)
    # Evaluations always ignore masked-out pixels, so that metrics are comparable between runs.
    masks = run.config.masks if split == "train" else "ignored"
    parsed = run.parse(split)
    if most is not None and parsed.num_scales == 1 and parsed.source_images is None:
        parsed = parsed[torch.tensor(strided(len(parsed.image_paths), most), dtype=torch.int64)]
    return load_dataset(parsed, split, memory, masks)


def first_split(run: Run, splits: tuple[Split, ...], most: int | None = None) -> Dataset | None:
    """Parse and decode the first readable split of several; unreadable ones are reported.

    Args:
        run: the run, as for `load_split`.
        splits: splits to try, in order.
        most: maximum number of images, as for `load_split`.

    Returns:
        The data set; None if no split can be read.
    """
    for split in splits:
        try:
            return load_split(run, split, most)
        except DataError as error:
            say(f"no '{split}' images to evaluate on: {error}")
    return None
