"""Tables in memory-mapped files, for parameters and optimiser states that are larger than memory.

Pages of a mapped file count as the process's memory until they are released. A released page that is used again comes
from the system's cache or from the disk.
"""

from __future__ import annotations

import math
import mmap
import os
import tempfile
from pathlib import Path
from typing import IO
from weakref import WeakSet

import torch
from torch import Tensor

from nerfloom.base.errors import ConfigError
from nerfloom.base.optimised import RowChange
from nerfloom.kernels.table_memory import Tables, page_out

PIECE = 2**16
"""Number of rows that are copied before memory is released."""
BLOCK = 2**24
"""Number of bytes that are written at once where the system cannot allocate a file."""


class MappedTables(Tables):
    """Tables in files without a name: the system removes a file when its table is not used any more, or after a kill.

    Args:
        folder: folder of the files, created if missing. It should be on a disk, not in memory.
    """

    in_files = True

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._maps: WeakSet[mmap.mmap] = WeakSet()

    def zeros(self, *shape: int, like: Tensor) -> Tensor:
        size = math.prod(shape) * like.element_size()
        if not size:  # which cannot be mapped
            return like.new_zeros(shape)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=self.folder) as file:
                _allocate(file, size)
                mapped = mmap.mmap(file.fileno(), size)
        except (OSError, ValueError) as error:
            raise ConfigError(
                f"--memory-limit: cannot keep a table of {size / 1e6:,.0f} MB in {self.folder} ({error}); free some "
                "space, or choose another --cache-dir"
            ) from error
        self._maps.add(mapped)
        return torch.frombuffer(mapped, dtype=like.dtype).view(shape)

    def kept(self, values: Tensor) -> Tensor:
        return self.copied(values, values)

    def copied(self, values: Tensor, like: Tensor) -> Tensor:
        out = self.zeros(*values.shape, like=like)
        for first in range(0, len(values), PIECE):
            piece = values[first : first + PIECE]
            out[first : first + PIECE] = piece
            page_out(piece)
            self.release()
        return out

    def changed(self, values: Tensor, change: RowChange, fresh: Tensor | None) -> Tensor:
        before, added = len(values), 0 if change.fresh is None else len(change.fresh)
        sources = torch.cat([change.kept, before + torch.arange(added)])
        if change.order is not None:
            sources = sources[change.order]
        out = self.zeros(len(sources), *values.shape[1:], like=values)
        for first in range(0, len(sources), PIECE):
            piece, rows = sources[first : first + PIECE], out[first : first + PIECE]
            old = piece < before
            rows[old] = values[piece[old]]
            if fresh is not None:
                rows[~old] = fresh[piece[~old] - before].to(rows)
            self.release()
        return out

    def release(self) -> None:
        for mapped in self._maps:
            if hasattr(mapped, "madvise"):  # Windows takes pages back by itself
                mapped.madvise(mmap.MADV_DONTNEED)


def _allocate(file: IO[bytes], size: int) -> None:
    """Allocate the space of an empty file. Without it, a write to a mapping on a full disk would end the process."""
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(file.fileno(), 0, size)
        return
    for done in range(0, size, BLOCK):
        file.write(bytes(min(BLOCK, size - done)))
    file.flush()
