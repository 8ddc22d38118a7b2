"""Files that accompany images, such as masks and depth images, as the frames of a JSON file name them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from nerfloom.base.splits import Split
from nerfloom.data.names_on_disk import on_disk
from nerfloom.dataparsers.reading import Frames, file_name


def companions(
    folder: Path, frames: Frames, key: str, endings: Sequence[str], split: Split
) -> tuple[Path | None, ...] | None:
    """Return the files that frames name as companions of their images.

    Args:
        folder: folder that the names are relative to.
        frames: M frames.
        key: entry that names the file.
        endings: endings of such files, in lower case.
        split: the split to read; differences of spelling are reported in training only.

    Returns:
        M paths, None for a frame without one; None if no frame has one.

    Raises:
        DataError: if an entry is not the name of a file.
    """
    written = [file_name(frame[key], key, label) for frame, label in frames if frame.get(key) is not None]
    if not written:
        return None
    files = iter(on_disk(folder, written, f"files of '{key}'", endings, split != "train", shared=2))
    return tuple(None if frame.get(key) is None else next(files) for frame, _ in frames)
