"""Destinations of decoded images: an array in memory, or a file."""

from __future__ import annotations

import errno
import os
import threading
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO, Protocol

import numpy as np

CHUNK = 2**24
"""Number of bytes moved at once."""


class PixelStore(Protocol):
    """Bytes that are written and read by position, possibly by several threads at once."""

    def write(self, start: int, values: np.ndarray) -> None:
        """Write uint8 `values` (N,) at byte `start`."""

    def read(self, start: int, count: int) -> np.ndarray:
        """Return a copy (count,) uint8 of `count` bytes at byte `start`."""


class MemoryStore(PixelStore):
    """An array of `size` bytes in memory."""

    def __init__(self, size: int) -> None:
        self._values = np.empty(size, np.uint8)

    def write(self, start: int, values: np.ndarray) -> None:
        self._values[start : start + len(values)] = values

    def read(self, start: int, count: int) -> np.ndarray:
        return self._values[start : start + count].copy()

    def finish(self, size: int) -> np.ndarray:
        """Return the first `size` bytes as (size,) uint8, and free the rest."""
        if size < len(self._values):
            self._values.resize(size, refcheck=False)  # in place: a copy would need twice the memory
        return self._values


class FileStore(PixelStore):
    """A new file.

    The file is written, not mapped: on a full disk a write fails, whereas a mapping would kill the process. Its space
    is allocated at once if the system can, so that a full disk is noticed before decoding.

    Args:
        path: the file to create.
        size: its size in bytes.

    Raises:
        OSError: if the disk lacks space.
    """

    def __init__(self, path: Path, size: int) -> None:
        self.path, self._lock = path, threading.Lock()
        self._file: BinaryIO = path.open("w+b")
        try:
            if size and hasattr(os, "posix_fallocate"):
                os.posix_fallocate(self._file.fileno(), 0, size)
        except OSError as error:
            if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
                self.discard()
                raise
            # Otherwise the file system cannot allocate, and a full disk is noticed while writing.

    def write(self, start: int, values: np.ndarray) -> None:
        with self._lock:
            self._file.seek(start)
            self._file.write(np.ascontiguousarray(values).data)

    def read(self, start: int, count: int) -> np.ndarray:
        with self._lock:
            self._file.seek(start)
            return np.frombuffer(self._file.read(count), np.uint8)

    def finish(self, size: int, ending: bytes, path: Path) -> None:
        """Keep `size` bytes, append `ending`, and rename the file to `path` once it is safely on the disk."""
        with self._lock:
            self._file.truncate(size)
            self._file.seek(size)
            self._file.write(ending)
            self._file.flush()
            os.fsync(self._file.fileno())
            self._file.close()
            os.replace(self.path, path)

    def discard(self) -> None:
        """Remove the file."""
        with suppress(OSError):  # closing flushes buffers, which fails on a full disk
            self._file.close()
        self.path.unlink(missing_ok=True)


def move(store: PixelStore, source: int, target: int, count: int) -> None:
    """Move `count` bytes from position `source` to an earlier position `target` of `store`."""
    for done in range(0, count if target < source else 0, CHUNK):
        store.write(target + done, store.read(source + done, min(CHUNK, count - done)))


def drop_fourth(store: PixelStore, pixels: int) -> None:
    """Convert the first `pixels` pixels of `store` from four channels to three, in place."""
    for done in range(0, pixels, CHUNK // 4):
        count = min(CHUNK // 4, pixels - done)
        rgba = store.read(4 * done, 4 * count).reshape(-1, 4)
        store.write(3 * done, np.ascontiguousarray(rgba[:, :3]).reshape(-1))
