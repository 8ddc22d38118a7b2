"""The images of a run, split by split."""

from __future__ import annotations

from framework.base.console import say
from framework.base.errors import DataError
from framework.data.dataset import Dataset, Split, load_dataset
from framework.data.pixel_cache import PixelMemory
from framework.training.run import Run


def load_split(run: Run, split: Split) -> Dataset:
    """Parse and decode a split of a run's data.

    Args:
        run: it says which data, which format, and how many pixels may be in memory.
        split: train, val or test.
    Raises: DataError where the data is missing, or as its format does.
    """
    memory = PixelMemory.of(run.config.cache_limit, run.config.cache_dir)
    # Masks tell what counts in an evaluation, whatever they mean in training: its figures stay comparable.
    masks = run.config.masks if split == "train" else "ignored"
    return load_dataset(run.parse(split), split, memory, masks)


def first_split(run: Run, splits: tuple[Split, ...]) -> Dataset | None:
    """Parse and decode the first of several splits that can be read; each that cannot is reported.

    Args:
        run: as for `load_split`.
        splits: in the order in which they are tried.
    Returns: the images; None where no split can be read.
    """
    for split in splits:
        try:
            return load_split(run, split)
        except DataError as error:
            say(f"no '{split}' images to evaluate on: {error}")
    return None
