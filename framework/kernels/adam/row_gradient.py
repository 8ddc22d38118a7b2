"""Gradient of a table where a step uses few rows, such as the leaves of an octree, or one network per row."""

from __future__ import annotations

import torch
from torch import Tensor

from nerfloom.kernels import native
from nerfloom.kernels.adam.deferred import DeferredGradient, waiting
from nerfloom.kernels.dispatch import CPP, Operation

_adam = native.Function("adam_rows", "ppppppqifddfi")


class RowGradient(DeferredGradient):
    """The deferred gradient of a table: rows (T,) int32, each once, and gradients (T, F), of each backward pass."""

    def summed(self, table: Tensor) -> Tensor:
        total = torch.zeros_like(table)
        for rows, gradient in self.parts:
            total.index_add_(0, rows, gradient)
        self.clear()
        return total

    def adam(
        self, table: Tensor, mean: Tensor, square: Tensor, seen: Tensor,
        rate: float, betas: tuple[float, float], eps: float,
    ) -> int | Tensor:  # fmt: skip
        rows, gradient = self._merged(len(table))
        shape, count = (table.shape[0], table.shape[1]), len(rows)
        _adam(
            native.pointer(table, "the table", shape), native.pointer(mean, "mean", shape),
            native.pointer(square, "square", shape), native.pointer(seen, "seen", shape[:1]),
            native.pointer(gradient, "the gradient", (count, shape[1])),
            native.pointer(rows, "rows", (count,), torch.int32), count, shape[1], rate, *betas, eps,
            native.threads(),
        )  # fmt: skip
        self.clear()
        return count

    def _merged(self, num_rows: int) -> tuple[Tensor, Tensor]:
        """Return the rows (T,) int32 of all parts, each once, and the sum (T, F) of their gradients."""
        rows, first = self.parts[0]
        if all(torch.equal(others, rows) for others, _ in self.parts[1:]):
            return rows, sum(self.gradients[1:], first).contiguous()
        used = torch.zeros(num_rows, dtype=torch.bool)
        for some, _ in self.parts:
            used[some.long()] = True
        all_rows = used.nonzero()[:, 0]
        place = torch.empty(num_rows, dtype=torch.int64)
        place[all_rows] = torch.arange(len(all_rows))
        total = torch.zeros(len(all_rows), first.shape[1])
        for some, gradient in self.parts:
            total[place[some.long()]] += gradient  # each row of a part is there once
        return all_rows.int(), total


def table_rows_reference(table: Tensor, rows: Tensor, deferred: RowGradient | None = None) -> Tensor:
    """Compute `table_rows` in PyTorch, on any device and for any float type, with the gradient of autograd.

    `table`, `rows` and `deferred` are as in `table_rows`; `deferred` is not used.
    """
    return table.index_select(0, rows)


def table_rows(table: Tensor, rows: Tensor, deferred: RowGradient | None = None) -> Tensor:
    """Return rows (T, F) of a table.

    Args:
        table: (E, F) parameters.
        rows: (T,) int64 indices of rows, each at most once.
        deferred: collects the gradient of the table, on compiled kernels; None to return it.

    Raises:
        IndexError: if a row does not exist.
    """
    return TABLE_ROWS((table,), table, rows, deferred)


TABLE_ROWS = Operation("table_rows", table_rows_reference)


@TABLE_ROWS.implementation(CPP)
def _deferred_rows(table: Tensor, rows: Tensor, deferred: RowGradient | None = None) -> Tensor:
    if deferred is None:
        return table.index_select(0, rows)
    return table.detach().index_select(0, rows) + waiting(table, rows.int(), table.shape[1], deferred.parts)
