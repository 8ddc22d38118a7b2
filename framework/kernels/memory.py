"""Memory for tables that are read all over."""

from __future__ import annotations

import ctypes
import functools
import math
import sys
from typing import Any

import torch
from torch import Tensor

from framework.base.device import machine_memory
from framework.base.errors import ConfigError

HUGE_PAGE = 2**21
_MADV_HUGEPAGE = 14


@functools.cache
def _madvise() -> Any:
    return getattr(ctypes.CDLL(None), "madvise", None) if sys.platform == "linux" else None


def require(size: float, what: str) -> None:
    """Refuse what this machine cannot hold, before the system stops the process for it.

    Args:
        size: bytes.
        what: takes them, as in "a table".
    Raises: ConfigError that names both sizes.
    """
    there = machine_memory()
    if size > there:
        raise ConfigError(
            f"these settings take {size / 2**30:,.1f} GiB for {what}; this machine has {there / 2**30:,.1f} GiB"
        )


def table(*shape: int, like: Tensor | None = None) -> Tensor:
    """Zeros of a shape, on `like`'s device and of its type, on pages of 2 MB where the system has them.

    Random reads from a table of many small pages miss the processor's page cache each time.

    Raises: ConfigError where the machine has less memory than they take.
    """
    require(4.0 * math.prod(shape), "a table")
    if like is None:
        out = torch.empty(shape)
    else:
        out = torch.empty(shape, dtype=like.dtype, device=like.device)
    advise = _madvise()
    size = out.numel() * out.element_size()
    if advise is not None and out.device.type == "cpu" and size >= 2 * HUGE_PAGE:
        first = -(-out.data_ptr() // HUGE_PAGE) * HUGE_PAGE
        last = (out.data_ptr() + size) // HUGE_PAGE * HUGE_PAGE
        advise(ctypes.c_void_p(first), ctypes.c_size_t(last - first), _MADV_HUGEPAGE)  # a hint: failing is harmless
    return out.zero_()
