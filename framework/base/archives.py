"""Zip files, the container of PyTorch's checkpoints and of numpy's .npz: a small file may expand beyond memory."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import BinaryIO


def uncompressed_size(file: Path | BinaryIO) -> int:
    """Return the uncompressed size in bytes of all entries of the zip `file`, as its directory states it.

    Raises:
        zipfile.BadZipFile: if `file` is not a zip file. A damaged one may raise other errors.
    """
    with zipfile.ZipFile(file) as archive:
        return sum(entry.file_size for entry in archive.infolist())
