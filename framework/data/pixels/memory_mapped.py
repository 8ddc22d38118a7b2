"""Pixels in a memory-mapped file; only a bounded part of it is in memory."""

from __future__ import annotations

import mmap
import warnings
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

MAX_SLICE = 64_000_000
"""Maximum number of bytes read before their pages are dropped."""
MIN_SLICE = 2**20
"""Minimum number of bytes read before their pages are dropped."""


class MappedPixels:
    """The pixels of a file.

    Pages of a mapped file count as the process's memory until they are dropped or the system reclaims them. So readers
    go through the file in order and drop the pages behind them. A dropped page that is read again comes from the
    system's cache or from the disk.

    Args:
        path: a file that begins with the pixels.
        count: number of pixels P.
        channels: number of channels C.
        limit: bytes of pixels allowed in memory; a slice has at most an eighth of it.
    """

    def __init__(self, path: Path, count: int, channels: int, limit: float) -> None:
        self.path = path
        self.slice = int(min(max(limit / 8, MIN_SLICE), MAX_SLICE))
        """Number of bytes read before pages are dropped."""
        with path.open("rb") as file:
            # Read-only: the system would reserve memory for a writable private mapping.
            self._map = mmap.mmap(file.fileno(), count * channels, access=mmap.ACCESS_READ)
        self._stored = np.frombuffer(self._map, np.uint8).reshape(count, channels)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # PyTorch warns that tensors cannot be read-only
            self.pixels: Tensor = torch.from_numpy(self._stored)
            """(P, C) uint8 over the mapping; never written to."""

    def drop(self, first: int = 0, last: int | None = None) -> None:
        """Release the memory of the pixels from `first` to `last` - 1; all by default."""
        if not hasattr(self._map, "madvise"):  # Windows reclaims pages by itself
            return
        channels = self._stored.shape[1]
        start = first * channels // mmap.PAGESIZE * mmap.PAGESIZE
        end = len(self._map) if last is None else last * channels
        if end > start:
            self._map.madvise(mmap.MADV_DONTNEED, start, end - start)

    def take(self, flat: np.ndarray) -> np.ndarray:
        """Return the stored colours (R, C) of pixels in ascending order.

        Uses numpy, which releases Python's global lock and runs on one thread, so that training continues meanwhile.

        Args:
            flat: (R,) int64 numbers of the pixels, ascending.
        """
        out = np.empty((len(flat), self._stored.shape[1]), np.uint8)
        start, pixels = 0, max(self.slice // self._stored.shape[1], 1)
        while start < len(flat):
            first = int(flat[start])
            end = int(np.searchsorted(flat, first + pixels))
            np.take(self._stored, flat[start:end], axis=0, out=out[start:end], mode="clip")
            self.drop(first, min(first + pixels, len(self._stored)))
            start = end
        return out

    def look_up(self, flat: Tensor) -> Tensor:
        """Return the stored colours (R, C) of the pixels `flat` (R,), read in the file's order."""
        order = np.argsort(flat.numpy(), kind="stable")
        out = np.empty((len(flat), self._stored.shape[1]), np.uint8)
        out[order] = self.take(flat.numpy()[order])
        return torch.from_numpy(out)
