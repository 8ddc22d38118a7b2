"""Memory for large tables with random access, and the place of tables that an optimiser updates."""

from __future__ import annotations

import ctypes
import functools
import math
import mmap
import sys
from typing import Any

import torch
from torch import Tensor

from nerfloom.base.device import machine_memory
from nerfloom.base.errors import ConfigError
from nerfloom.base.optimised import RowChange

HUGE_PAGE = 2**21
"""Size of a huge page in bytes."""
_MADV_HUGEPAGE, _MADV_PAGEOUT = 14, 21


@functools.cache
def _madvise() -> Any:
    return getattr(ctypes.CDLL(None), "madvise", None) if sys.platform == "linux" else None


def require(size: float, what: str) -> None:
    """Check that the machine has enough memory, before the system would end the process.

    Args:
        size: number of bytes needed.
        what: purpose of the memory, such as "a table", for the error.

    Raises:
        ConfigError: if the machine has less memory.
    """
    available = machine_memory()
    if size > available:
        raise ConfigError(
            f"these settings need {size / 2**30:,.1f} GiB for {what}; this machine has {available / 2**30:,.1f} GiB"
        )


def table(*shape: int, like: Tensor | None = None) -> Tensor:
    """Return zeros, in pages of 2 MB if the system supports them.

    Random reads from a table of many small pages miss the CPU's translation cache almost every time.

    Args:
        shape: shape of the result.
        like: tensor that determines device and type; None for the defaults.

    Raises:
        ConfigError: if the machine has less memory.
    """
    require(4.0 * math.prod(shape), "a table")
    out = torch.empty(shape) if like is None else torch.empty(shape, dtype=like.dtype, device=like.device)
    if out.numel() * out.element_size() >= 2 * HUGE_PAGE:
        _advise(out, HUGE_PAGE, _MADV_HUGEPAGE)
    return out.zero_()


def page_out(values: Tensor) -> None:
    """Let the system take back the memory of `values` if it is also in a file. The values stay as they are."""
    if values.is_contiguous():
        _advise(values, mmap.PAGESIZE, _MADV_PAGEOUT)


def _advise(values: Tensor, page: int, advice: int) -> None:
    """Advise the system about the whole pages of contiguous `values`, where it can be advised."""
    advise = _madvise()
    if advise is not None and values.device.type == "cpu":
        first = -(-values.data_ptr() // page) * page
        last = (values.data_ptr() + values.numel() * values.element_size()) // page * page
        if last > first:
            advise(ctypes.c_void_p(first), ctypes.c_size_t(last - first), advice)  # a hint: failing is harmless


class Tables:
    """The place of tables and of their optimiser's state: memory. `mapped_tables.MappedTables` keeps them in files."""

    in_files: bool = False
    """Whether tables are in files, so that they may be larger than memory."""

    def zeros(self, *shape: int, like: Tensor) -> Tensor:
        """Return a new table of zeros.

        Args:
            shape: its shape.
            like: tensor that determines device and type.

        Raises:
            ConfigError: if there is not enough space.
        """
        return table(*shape, like=like)

    def kept(self, values: Tensor) -> Tensor:
        """Return a table with given `values` (E, ...), possibly `values` itself.

        Raises:
            ConfigError: if there is not enough space.
        """
        return values

    def copied(self, values: Tensor, like: Tensor) -> Tensor:
        """Return a new table with given values.

        Args:
            values: (E, ...) the values, possibly in a mapped checkpoint.
            like: tensor that determines device and type.

        Raises:
            ConfigError: if there is not enough space.
        """
        return self.zeros(*values.shape, like=like).copy_(values)

    def changed(self, values: Tensor, change: RowChange, fresh: Tensor | None) -> Tensor:
        """Return a table after a change of its rows.

        Args:
            values: (E, ...) the table, of the parameter or of its state.
            change: the kept rows, the number of new ones, and their order.
            fresh: (A, ...) values of the new rows; None for zeros.

        Raises:
            ConfigError: if there is not enough space.
        """
        rows = values.index_select(0, change.kept)
        if added := 0 if change.fresh is None else len(change.fresh):
            new = rows.new_zeros(added, *rows.shape[1:]) if fresh is None else fresh.to(rows)
            rows = torch.cat([rows, new])
        return rows if change.order is None else rows.index_select(0, change.order)

    def release(self) -> None:
        """Give memory back to the system where a table is also in a file; no table changes."""


IN_MEMORY = Tables()
"""The default place of tables."""
