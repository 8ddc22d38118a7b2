"""Gradients of tables that wait for the optimiser instead of being added up by autograd."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

Parts = list[tuple[Tensor, Tensor]]
"""Positions (N, D) and incoming gradient (N, width) of each look-up."""


class _Waiting(torch.autograd.Function):
    """A node between a look-up and its table, whose gradient is the look-up's own incoming gradient.

    Autograd calls a node's backward only in a pass that asks for something behind it. The look-up stands before its
    positions too, and would be called for those alone.
    """

    @staticmethod
    def forward(ctx: Any, table: Tensor, positions: Tensor, width: int, parts: Parts) -> Tensor:
        ctx.positions, ctx.parts = positions, parts
        return table.new_zeros(1, 1).expand(len(positions), width)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[None, ...]:
        ctx.parts.append((ctx.positions, grad))
        return None, None, None, None


def waiting(table: Tensor, positions: Tensor, width: int, parts: Parts) -> Tensor:
    """A stand-in for a look-up's table, so that its incoming gradient is left in `parts`.

    Only by a backward pass that asks for the table's gradient: `backward()`, or one whose `inputs` name the table.
    `autograd.grad` of the table finds no gradient to return; a look-up without `deferred` gives one.

    Args:
        table: (E, F) parameters.
        positions: (N, D) where they are looked up.
        width: features of the result.
    Returns: (N, width) no values. Its gradient, which the look-up gives, is that of its result.
    """
    return _Waiting.apply(table, positions.detach(), width, parts)
