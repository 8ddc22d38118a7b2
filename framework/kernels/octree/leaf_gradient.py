"""The gradient of an octree's leaves, of which a step sees few."""

from __future__ import annotations

from torch import Tensor

from nerfloom.kernels import table_memory
from nerfloom.kernels.adam.adam import sparse_adam


class LeafGradient:
    """The deferred gradient of a table of leaves: rows collected in backward passes, in memory kept between steps.

    A step sees few leaves. Adam sets the rows that it has used to zero again. It fills the place of
    `nerfloom.kernels.grids.hash_grid_lookup.TableGradient`.
    """

    def __init__(self) -> None:
        self._sum: Tensor | None = None
        self.pending = False
        """True if there is a gradient."""

    @property
    def gradients(self) -> list[Tensor]:
        """The gradient, if there is one."""
        return [self._sum] if self.pending and self._sum is not None else []

    def rows(self, table: Tensor) -> Tensor:
        """Return the memory (L, F) that gradients of `table` (L, F) are added to."""
        if self._sum is None or self._sum.shape != table.shape:
            self._sum = table_memory.table(*table.shape)
        self.pending = True
        return self._sum

    def clear(self) -> None:
        """Discard the gradient."""
        if self.pending and self._sum is not None:
            self._sum.zero_()
        self.pending = False

    def summed(self, table: Tensor) -> Tensor:
        """Return the gradient (L, F) of `table`; the caller sets it to zero again."""
        out = self.rows(table)
        self.pending = False
        return out

    def adam(
        self, table: Tensor, mean: Tensor, square: Tensor, seen: Tensor,
        rate: float, betas: tuple[float, float], eps: float,
    ) -> int | Tensor:  # fmt: skip
        """Update `table` (L, F) by `kernels.adam.adam.sparse_adam` with this gradient, and discard the gradient.

        `mean`, `square`, `seen`, `rate`, `betas`, `eps` and the result are as in `sparse_adam`.
        """
        return sparse_adam(table, self.summed(table), mean, square, seen, rate, betas, eps)
