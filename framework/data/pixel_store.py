"""Where decoded images are written to, each in its place: an array in memory, or a file."""

from __future__ import annotations

import errno
import os
import threading
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO, Protocol

import numpy as np

PIECE = 2**24
"""Bytes that are moved at once."""


class PixelStore(Protocol):
    """Bytes that are written and read by place; several threads may do so at once."""

    def write(self, start: int, values: np.ndarray) -> None:
        """Put uint8 values (N,) at byte `start`."""

    def read(self, start: int, count: int) -> np.ndarray:
        """A copy, (count,) uint8, of what stands at byte `start`."""


class MemoryStore:
    """An array of `size` bytes in memory."""

    def __init__(self, size: int) -> None:
        self._values = np.empty(size, np.uint8)

    def write(self, start: int, values: np.ndarray) -> None:
        """As `PixelStore.write`."""
        self._values[start : start + len(values)] = values

    def read(self, start: int, count: int) -> np.ndarray:
        """As `PixelStore.read`."""
        return self._values[start : start + count].copy()

    def finish(self, size: int) -> np.ndarray:
        """The first `size` bytes, (size,) uint8; the rest is given back."""
        if size < len(self._values):
            self._values.resize(size, refcheck=False)  # in place: a copy would need the memory twice
        return self._values


class FileStore:
    """A new file of `size` bytes.

    It is written to, not mapped: on a full disk a write fails, where a mapping would kill the process. Its space is
    taken at once where the system can, so that a full disk is known before anything is decoded.

    Raises: OSError where there is no room.
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
            # else a file system that cannot: it will be seen while writing

    def write(self, start: int, values: np.ndarray) -> None:
        """As `PixelStore.write`. Raises: OSError."""
        with self._lock:
            self._file.seek(start)
            self._file.write(np.ascontiguousarray(values).data)

    def read(self, start: int, count: int) -> np.ndarray:
        """As `PixelStore.read`."""
        with self._lock:
            self._file.seek(start)
            return np.frombuffer(self._file.read(count), np.uint8)

    def finish(self, size: int, ending: bytes, path: Path) -> None:
        """Cut the file at `size` bytes, write `ending` behind, and give it its name once it is safe on the disk."""
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
        with suppress(OSError):  # closing writes what is left, and may find no room for it
            self._file.close()
        self.path.unlink(missing_ok=True)


def move(store: PixelStore, source: int, target: int, count: int) -> None:
    """Move `count` bytes towards the beginning."""
    for done in range(0, count if target < source else 0, PIECE):
        store.write(target + done, store.read(source + done, min(PIECE, count - done)))


def drop_fourth(store: PixelStore, pixels: int) -> None:
    """Turn the first `pixels` groups of four bytes into as many of three, in place."""
    for done in range(0, pixels, PIECE // 4):
        count = min(PIECE // 4, pixels - done)
        four = store.read(4 * done, 4 * count).reshape(-1, 4)
        store.write(3 * done, np.ascontiguousarray(four[:, :3]).reshape(-1))
