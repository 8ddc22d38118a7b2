"""Selection of rows of tensors, each at most once."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate
from typing import Any

import torch
from torch import Tensor

from nerfloom.kernels import native
from nerfloom.kernels.argument_checks import check_indices
from nerfloom.kernels.dispatch import CPP, INT64, Operation

_gather = native.Function("gather_rows", "ppipipqpi")


class _TakeRows(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, rows: Tensor) -> Tensor:
        ctx.save_for_backward(rows)
        ctx.count = len(values)
        return values.index_select(0, rows)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        (rows,) = ctx.saved_tensors
        return grad.new_zeros(ctx.count, *grad.shape[1:]).index_copy(0, rows, grad), None


def take_rows(values: Tensor, rows: Tensor) -> Tensor:
    """Return `values[rows]` without repeated rows, so that the gradient is a copy instead of a sum.

    Args:
        values: (N, ...) values.
        rows: (M,) int64 indices of rows, all different.
    """
    return _TakeRows.apply(values, rows)


@torch.no_grad()
def gather_rows(columns: Sequence[Sequence[Tensor]], order: Tensor) -> list[Tensor]:
    """Return rows of several tensors given in parts, without concatenating the parts first.

    Args:
        columns: the P parts (N_p, ...) of each tensor; the lengths N_p are the same for all tensors.
        order: (M,) int64 indices of rows, counted over all parts.

    Returns:
        (M, ...) rows of each tensor, without gradient.

    Raises:
        IndexError: if an index is out of range.
    """
    return GATHER_ROWS((order,), columns, order)


def gather_rows_reference(columns: Sequence[Sequence[Tensor]], order: Tensor) -> list[Tensor]:
    """Compute `gather_rows` of `columns` and `order` in PyTorch, on any device."""
    check_indices(order, sum(len(part) for part in columns[0]), "rows")
    return [joined(parts).index_select(0, order) for parts in columns]


def joined(parts: Sequence[Tensor]) -> Tensor:
    """Return `parts` concatenated; a single one is not copied."""
    return parts[0] if len(parts) == 1 else torch.cat(list(parts))


GATHER_ROWS = Operation("gather_rows", gather_rows_reference)


@GATHER_ROWS.implementation(CPP, types=INT64)
def _compiled(columns: Sequence[Sequence[Tensor]], order: Tensor) -> list[Tensor]:
    first = columns[0]
    ends = tuple(accumulate(part.shape[0] for part in first))
    kept = [part.contiguous() for parts in columns for part in parts]
    shapes = [(end - start, *parts[0].shape[1:]) for parts in columns for start, end in zip((0, *ends), ends)]  # noqa: B905
    out = [parts[0].new_empty(len(order), *parts[0].shape[1:]) for parts in columns]
    addresses = [native.pointer(part, "a part", shape, part.dtype) for part, shape in zip(kept, shapes, strict=True)]
    _gather(
        native.pointers(addresses), native.integers(tuple(t[:1].numel() * t.element_size() for t in out)), len(out),
        native.integers(ends), len(first), native.pointer(order, "the order", (len(order),), torch.int64), len(order),
        native.pointers([t.data_ptr() for t in out]), native.threads(),
    )  # fmt: skip
    return out
