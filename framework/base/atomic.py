"""Atomic writes: a file is complete or absent, even after a kill or on a full disk."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

MAX_START = 200
"""Maximum number of bytes of a file's name in that of its temporary file; systems allow 255 in all."""


def write_atomically(path: Path, write: Callable[[BinaryIO], object], flush: bool = True) -> None:
    """Call `write(file)` on a temporary binary file beside `path`, flush it to disk and rename it.

    Args:
        path: the file.
        write: writes its content.
        flush: False for files that may be damaged after a loss of power, because they can be made again.

    Raises:
        OSError: if the file cannot be written; `path` is then unchanged, and no temporary file is left.
    """
    start = os.fsencode(path.name)[:MAX_START].decode(errors="ignore")
    temporary = path.with_name(f".{start}.{os.getpid()}.{threading.get_native_id()}.tmp")
    try:
        with temporary.open("wb") as file:
            write(file)
            if flush:
                file.flush()
                os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    if flush:
        _flush_folder(path.parent)


def _flush_folder(folder: Path) -> None:
    """Flush the names in a folder to disk, so that a new file is there before older ones are removed."""
    with suppress(OSError):  # Windows cannot open folders, and some file systems cannot flush them
        opened = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(opened)
        finally:
            os.close(opened)
