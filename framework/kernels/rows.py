"""Choosing rows of a tensor, each at most once."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


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
    """`values[rows]` where no row is chosen twice: the gradient is a copy, where `index_select` has to add.

    Args:
        values: (N, ...).
        rows: (M,) int64, all different.
    """
    return _TakeRows.apply(values, rows)
