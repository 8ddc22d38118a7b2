"""Pixels that lie in a file and are read through a mapping, of which only a part is ever in the process's memory."""

from __future__ import annotations

import mmap
import warnings
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

SLICE = 64_000_000
"""Bytes of the file that are looked at before what was read of them is dropped, at most."""
SMALLEST_SLICE = 2**20


class MappedPixels:
    """The pixels of a file.

    Pages of a file that were read count as the process's memory until they are dropped, or until the system needs
    them. So whoever reads goes through the file in order, and drops what lies behind. Dropping takes nothing away: a
    page that is read again comes from the system's cache, or from the disk.

    Args:
        path: a file that begins with the pixels.
        count: how many; P.
        channels: C.
        limit: bytes of pixels that may be in memory; an eighth of it is a slice of the file.
    """

    def __init__(self, path: Path, count: int, channels: int, limit: float) -> None:
        self.path = path
        self.slice = int(min(max(limit / 8, SMALLEST_SLICE), SLICE))
        """Bytes that are read before pages are dropped."""
        with path.open("rb") as file:
            # Read-only: a mapping that could be written to would have to fit into memory with all others.
            self._map = mmap.mmap(file.fileno(), count * channels, access=mmap.ACCESS_READ)
        self._stored = np.frombuffer(self._map, np.uint8).reshape(count, channels)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torch knows no read-only tensors, and says so
            self.pixels: Tensor = torch.from_numpy(self._stored)
            """(P, C) uint8 over the mapping; never written to."""

    def drop(self, first: int = 0, last: int | None = None) -> None:
        """Let go of the memory of the pixels first .. last - 1; of all if not given."""
        if not hasattr(self._map, "madvise"):  # Windows takes pages back by itself
            return
        channels = self._stored.shape[1]
        start = first * channels // mmap.PAGESIZE * mmap.PAGESIZE
        end = len(self._map) if last is None else last * channels
        if end > start:
            self._map.madvise(mmap.MADV_DONTNEED, start, end - start)

    def take(self, flat: np.ndarray) -> np.ndarray:
        """Stored colours (R, C) of the pixels `flat` (R,) int64, which ascend.

        numpy, not torch: it lets Python's lock go and takes one thread, so that a step goes on meanwhile.
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
        """Stored colours (R, C) of any pixels (R,), read in the file's order."""
        order = np.argsort(flat.numpy(), kind="stable")
        out = np.empty((len(flat), self._stored.shape[1]), np.uint8)
        out[order] = self.take(flat.numpy()[order])
        return torch.from_numpy(out)
