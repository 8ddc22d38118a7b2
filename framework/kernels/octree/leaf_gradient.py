"""The gradient of an octree's leaves; a step sees few of them."""

from __future__ import annotations

import torch
from torch import Tensor

from nerfloom.kernels import native
from nerfloom.kernels.adam.adam import sparse_adam

_adam = native.Function("octree_adam", "ppppppqifddfi")


class LeafGradient:
    """The deferred gradient of a table of leaves: rows of the leaves that rays have met, from each backward pass.

    It fills the place of `nerfloom.kernels.grids.hash_grid_lookup.TableGradient`.
    """

    def __init__(self) -> None:
        self.parts: list[tuple[Tensor, Tensor]] = []
        """Leaves (T,) int32, each once, and their gradient (T, F), of each backward pass."""

    @property
    def pending(self) -> bool:
        """True if there is a gradient."""
        return bool(self.parts)

    @property
    def gradients(self) -> list[Tensor]:
        """The collected gradients (T, F)."""
        return [rows for _, rows in self.parts]

    def clear(self) -> None:
        """Discard the gradient."""
        self.parts.clear()

    def summed(self, table: Tensor) -> Tensor:
        """Return the gradient (L, F) of `table` and discard it."""
        total = torch.zeros_like(table)
        for leaves, rows in self.parts:
            total.index_add_(0, leaves, rows)
        self.clear()
        return total

    def adam(
        self, table: Tensor, mean: Tensor, square: Tensor, seen: Tensor,
        rate: float, betas: tuple[float, float], eps: float,
    ) -> int | Tensor:  # fmt: skip
        """Update `table` (L, F) by `kernels.adam.adam.sparse_adam` with this gradient, and discard the gradient.

        `mean`, `square`, `seen`, `rate`, `betas`, `eps` and the result are as in `sparse_adam`.
        """
        if len(self.parts) != 1:
            return sparse_adam(table, self.summed(table), mean, square, seen, rate, betas, eps)
        ((leaves, rows),) = self.parts
        shape, count = (table.shape[0], table.shape[1]), len(leaves)
        _adam(
            native.pointer(table, "the table", shape), native.pointer(mean, "mean", shape),
            native.pointer(square, "square", shape), native.pointer(seen, "seen", shape[:1]),
            native.pointer(rows, "the gradient", (count, shape[1])),
            native.pointer(leaves, "leaves", (count,), torch.int32), count, shape[1], rate, *betas, eps,
            native.threads(),
        )  # fmt: skip
        self.clear()
        return count
