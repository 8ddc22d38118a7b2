"""Files that accompany images, such as masks and depth images, as the frames of a JSON file name them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from nerfloom.base.splits import Split
from nerfloom.data.names_on_disk import on_disk
from nerfloom.dataparsers.reading import file_name


def companions(
    folder: Path,
    frames: Sequence[dict[str, Any]],
    key: str,
    labels: Sequence[str],
    endings: Sequence[str],
    split: Split,
) -> tuple[Path | None, ...] | None:
    """Return the files that frames name as companions of their images.

    Args:
        folder: folder that the names are relative to.
        frames: the JSON objects of M frames.
        key: entry that names the file.
        labels: M names of the frames in messages.
        endings: endings of such files, in lower case.
        split: the split to read; differences of spelling are reported in training only.

    Returns:
        M paths, None for a frame without one; None if no frame has one.

    Raises:
        DataError: if an entry is not the name of a file.
    """
    named = [frame.get(key) for frame in frames]
    if all(name is None for name in named):
        return None
    written = [file_name(name, key, label) for name, label in zip(named, labels, strict=True) if name is not None]
    files = iter(on_disk(folder, written, f"files of '{key}'", endings, split != "train", shared=2))
    return tuple(None if name is None else next(files) for name in named)
