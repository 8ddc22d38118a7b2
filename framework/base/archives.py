"""Zip files, in which torch and numpy keep arrays: a small one may stand for more than memory holds."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import BinaryIO


def unfolded_size(file: Path | BinaryIO) -> int:
    """Bytes that a zip file's entries take together once they are read, as its list of them says.

    Raises: zipfile.BadZipFile where it is none; what is damaged brings other errors too.
    """
    with zipfile.ZipFile(file) as archive:
        return sum(entry.file_size for entry in archive.infolist())
