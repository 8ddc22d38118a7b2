"""Gradients of tables that are kept for the optimiser instead of being accumulated by autograd."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import torch
from torch import Tensor

from nerfloom.kernels.adam.adam import sparse_adam

Parts = list[tuple[Tensor, Tensor]]
"""Positions (N, D) of each look-up, and gradient (N, width) of its result."""


class DeferredGradient(ABC):
    """The gradient of a table, collected in backward passes, which an optimiser sums and applies."""

    def __init__(self) -> None:
        self.parts: Parts = []
        """Parts of the gradient, one from each look-up in a backward pass."""

    @property
    def pending(self) -> bool:
        """True if there is a gradient."""
        return bool(self.parts)

    @property
    def gradients(self) -> list[Tensor]:
        """The collected gradients."""
        return [gradient for _, gradient in self.parts]

    def clear(self) -> None:
        """Discard the gradient."""
        self.parts.clear()

    @abstractmethod
    def summed(self, table: Tensor) -> Tensor:
        """Return the accumulated gradient (E, F) of `table` and discard it.

        The result's memory may be reused: its entries must be zero before the next call, as Adam leaves them.
        """

    def adam(
        self, table: Tensor, mean: Tensor, square: Tensor, seen: Tensor,
        rate: float, betas: tuple[float, float], eps: float,
    ) -> int | Tensor:  # fmt: skip
        """Update `table` (E, F) by `sparse_adam` with this gradient, and discard the gradient.

        `mean`, `square`, `seen`, `rate`, `betas`, `eps` and the result are as in `sparse_adam`.
        """
        return sparse_adam(table, self.summed(table), mean, square, seen, rate, betas, eps)


class _Waiting(torch.autograd.Function):
    """A node between a look-up and its table, which receives the gradient of the look-up's result.

    Autograd calls the backward of a node only in a pass that needs the gradient of one of its inputs. The look-up
    itself has the positions as a further input, so its backward may be called for the positions alone.
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
    """Return a placeholder for the table of a look-up; its backward appends the look-up's gradient to `parts`.

    It does so only in a backward pass that computes the gradient of the table: `backward()`, or one with the table
    among its `inputs`. `autograd.grad` of the table gets no gradient; use a look-up without `deferred` for that.

    Args:
        table: (E, F) parameters.
        positions: (N, D) positions of the look-up.
        width: number of features of the result.
        parts: positions and gradients of look-ups; this one's are appended.

    Returns:
        (N, width) zeros. The look-up must return the gradient of its result as the gradient of this tensor.
    """
    return _Waiting.apply(table, positions.detach(), width, parts)
