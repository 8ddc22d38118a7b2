"""Look-ups in a hash grid's table, for any kind of points: checks, autograd, and gradients deferred until Adam.

A look-up takes N rows of points, (N, 3) positions or (N, J, 4) points with a size, and returns L * F features per row.
It is defined by its reference and by compiled functions (`LookUp`).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import accumulate
from typing import Any

import torch
from torch import Tensor

from nerfloom.kernels import native, result_cache, table_memory
from nerfloom.kernels.adam.deferred import DeferredGradient, waiting
from nerfloom.kernels.grids.hash_grid_layout import HashGridLayout


@dataclass(frozen=True)
class LookUp:
    """A look-up: the shape of its points, and its compiled functions."""

    name: str
    """Name of the operation."""
    points: str
    """Name of the points, for errors."""
    shape: tuple[str | int, ...]
    """Shape of the points, with letters for free sizes, such as ("N", 3)."""
    forward: native.Function
    """Computes the features."""
    backward_table: native.Function
    """Accumulates the gradient of the table over several look-ups."""
    backward_points: native.Function | None
    """Computes the gradient of the points; None if they have none."""
    adam: native.Function
    """Applies the gradient of the table by Adam, for several look-ups."""
    results: int = 1
    """Number of results for each feature, such as its value and a derivative."""

    def check(self, points: Tensor, table: Tensor, layout: HashGridLayout) -> None:
        """Check the arguments of a look-up.

        Args:
            points: (N, ..., D) points.
            table: (E, F) entries of all levels.
            layout: resolutions and offsets of the levels.

        Raises:
            ValueError: if a shape does not fit the look-up or the layout.
        """
        rows = points.shape[1:-1]
        if points.ndim != len(self.shape) or points.shape[-1] != self.shape[-1] or 0 in rows:
            wanted = f"({', '.join(map(str, self.shape))})"
            raise ValueError(f"{self.name}: {self.points} have shape {tuple(points.shape)}, not {wanted}")
        if table.ndim != 2 or table.shape[0] != layout.num_entries:
            entries = f"({layout.num_entries}, F)"
            raise ValueError(f"{self.name}: the table has shape {tuple(table.shape)}, not {entries}")

    def address(self, points: Tensor) -> int:
        """Return the address of `points` (N, ..., D), checked."""
        return native.pointer(points, self.points, (*points.shape[:-1], int(self.shape[-1])))

    def compiled(self, points: Tensor, table: Tensor, layout: HashGridLayout, deferred: TableGradient | None) -> Tensor:
        """Return the features (N, L * F) by compiled code, with first derivatives.

        Args:
            points: (N, ..., D) points.
            table: (E, F) entries of all levels.
            layout: resolutions and offsets of the levels.
            deferred: collects the gradient of the table instead of autograd; None for autograd.
        """
        points, table, placeholder = points.contiguous(), table.contiguous(), None
        if deferred is not None and table.requires_grad:
            placeholder = waiting(table, points, layout.num_levels * table.shape[1], deferred.parts)
            table = table.detach()
        return _LookedUp.apply(points, table, placeholder, layout, self)


def fits(points: Tensor, table: Tensor, layout: HashGridLayout, deferred: TableGradient | None = None) -> bool:
    """Return whether kernels support the features of `table`; `points`, `layout` and `deferred` do not matter."""
    return table.shape[1] in (1, 2, 4, 8)


class TableGradient(DeferredGradient):
    """The deferred gradient of a table: points (N, ..., D) of encodings, and gradients (N, L * F) of their results.

    A step uses few entries. Accumulating the gradient level by level, each followed by Adam, takes one pass over the
    table; autograd's dense gradient takes many.

    Args:
        look_up: kind of look-up; its gradients are collected.
        layout: resolutions and offsets of the levels in use: all of the table's, or the first ones.
    """

    def __init__(self, look_up: LookUp, layout: HashGridLayout) -> None:
        super().__init__()
        self.look_up, self.layout = look_up, layout
        self._sum: Tensor | None = None

    def _arguments(self, features: int) -> tuple[Any, ...]:
        width, layout = self.layout.num_levels * features, (*self.layout.arrays, self.layout.num_levels)
        width *= self.look_up.results
        ends = native.integers(tuple(accumulate(len(points) for points, _ in self.parts)))
        inner = zip(*(points.shape[1:-1] for points, _ in self.parts), strict=True)  # numbers J, of points that have it
        points = native.pointers([self.look_up.address(points) for points, _ in self.parts])
        grads = native.pointers([native.pointer(g, "the gradient", (len(x), width)) for x, g in self.parts])
        return points, grads, ends, *map(native.integers, inner), len(self.parts), features, *layout

    def add_to(self, grad: Tensor) -> None:
        """Add the gradient to `grad` (E, F) and discard it."""
        shape = (self.layout.num_entries, grad.shape[1])
        into = native.pointer(grad[: shape[0]], "the table's gradient", shape)
        self.look_up.backward_table(*self._arguments(shape[1]), into, native.threads())
        self.parts.clear()

    def summed(self, table: Tensor) -> Tensor:
        if self._sum is None:
            self._sum = table_memory.table(*table.shape)
        self.add_to(self._sum)
        return self._sum

    def adam(
        self, table: Tensor, mean: Tensor, square: Tensor, seen: Tensor,
        rate: float, betas: tuple[float, float], eps: float,
    ) -> int:  # fmt: skip
        shape = (self.layout.num_entries, table.shape[1])
        table, mean, square, seen = (values[: shape[0]] for values in (table, mean, square, seen))
        updated: int = self.look_up.adam(
            *self._arguments(shape[1]), native.pointer(table, "the table", shape), native.pointer(mean, "mean", shape),
            native.pointer(square, "square", shape), native.pointer(seen, "seen", shape[:1]), rate, *betas, eps,
            native.threads(),
        )  # fmt: skip
        self.parts.clear()
        return updated


class _LookedUp(torch.autograd.Function):
    """The compiled form of a look-up."""

    @staticmethod
    def forward(
        ctx: Any, points: Tensor, table: Tensor, placeholder: Tensor | None, layout: HashGridLayout, look_up: LookUp
    ) -> Tensor:
        rows, features, where = points.shape[:-1], table.shape[1], look_up.address(points)
        entries = native.pointer(table, "the hash table", (layout.num_entries, features))

        def compute() -> Tensor:
            out = points.new_empty(rows[0], layout.num_levels * features)
            look_up.forward(
                where, *rows, entries, features, *layout.arrays, layout.num_levels, out.data_ptr(), native.threads()
            )
            return out

        ctx.save_for_backward(points, table)
        ctx.layout, ctx.look_up = layout, look_up
        return result_cache.result((look_up.name, layout), (points,), (table,), compute)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        points, table = ctx.saved_tensors
        layout, look_up, features = ctx.layout, ctx.look_up, table.shape[1]
        grad = grad.contiguous()
        incoming = native.pointer(grad, "the gradient", (len(points), layout.num_levels * features))
        grad_points = grad_table = None
        if ctx.needs_input_grad[1]:
            grad_table = torch.zeros_like(table)
            gradient = TableGradient(look_up, layout)
            gradient.parts.append((points, grad))
            gradient.add_to(grad_table)
        if ctx.needs_input_grad[0] and look_up.backward_points is not None:
            grad_points = torch.empty_like(points)
            look_up.backward_points(
                points.data_ptr(), *points.shape[:-1], table.data_ptr(), incoming, features, *layout.arrays,
                layout.num_levels, grad_points.data_ptr(), native.threads(),
            )  # fmt: skip
        return grad_points, grad_table, grad if ctx.needs_input_grad[2] else None, None, None
