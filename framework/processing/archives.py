"""Exports of apps as they are downloaded: zip files, unpacked into the output folder while they are converted."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from nerfloom.base.errors import DataError
from nerfloom.downloads.unpack import Place, names_of, unpack

UNPACKED = "unpacked"
"""Usual name of the folder of the files, in the output folder."""


def check_archive(archive: Path, place: Place, needs: str) -> None:
    """Check that a zip file `archive` has the file that it `needs`, with a `place`, before anything is written.

    Raises:
        DataError: if it has none, is damaged, or has an unsafe path.
    """
    if not any(place(parts) for parts in names_of(archive)):
        raise DataError(f"{archive} has no {needs}")


@contextmanager
def unpacked(data: Path, output: Path, place: Place, name: str = UNPACKED) -> Iterator[Path]:
    """Unpack a zip file within a `with` block.

    Args:
        data: the zip file, or a folder, which is yielded as it is.
        output: the output folder, claimed by `output.claim`.
        place: as in `unpack`.
        name: name of a new folder in the output folder.

    Yields:
        The folder of the files.

    Raises:
        DataError: as `unpack`: if the archive is damaged, too large, or leads out of the folder.
    """
    if data.is_dir():
        yield data
        return
    folder = output / name
    try:
        unpack(data, folder, place)
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
