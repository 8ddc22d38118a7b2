"""Data sets of a run, by split."""

from __future__ import annotations

from framework.base.console import say
from framework.base.errors import DataError
from framework.data.dataset import Dataset, Split, load_dataset
from framework.data.pixel_cache import PixelMemory
from framework.training.run import Run


def load_split(run: Run, split: Split) -> Dataset:
    """Parse and decode a split of a run's data.

    Args:
        run: the run, with the data's folder and format and the limit of pixels in memory.
        split: part of the data set.

    Raises:
        DataError: if the data is missing or cannot be read.
    """
    memory = PixelMemory.of(run.config.cache_limit, run.config.cache_dir)
    # In an evaluation masked-out pixels are always ignored, so that metrics are comparable between runs.
    masks = run.config.masks if split == "train" else "ignored"
    return load_dataset(run.parse(split), split, memory, masks)


def first_split(run: Run, splits: tuple[Split, ...]) -> Dataset | None:
    """Parse and decode the first of several splits that can be read; splits that cannot are reported.

    Args:
        run: the run, as for `load_split`.
        splits: splits in the order in which they are tried.

    Returns:
        The data set; None if no split can be read.
    """
    for split in splits:
        try:
            return load_split(run, split)
        except DataError as error:
            say(f"no '{split}' images to evaluate on: {error}")
    return None
