"""Hash encoding of conical frustums by a few points in each: Zip-NeRF (Barron et al. 2023), section 3.

The features of a frustum are the mean over its points, each weighted level by level with the share of its Gaussian that
lies within a cell (`level_weights`). The compiled form computes the mean while it looks up, so that features of single
points are never stored.

Letters: N frustums, J points in each, L levels, F features of an entry.
"""

from __future__ import annotations

from itertools import accumulate
from typing import Any

import torch
from torch import Tensor

from framework.kernels import kept, native
from framework.kernels.deferred import waiting
from framework.kernels.dispatch import CPP, Operation
from framework.kernels.downweighting import level_weights
from framework.kernels.hash_grid import HashGridLayout, TableGradient, corners

_forward = native.Function("multisampled_grid_forward", "pqipippipi")
_backward_table = native.Function("multisampled_grid_backward_table", "ppppiippipi")
_backward_points = native.Function("multisampled_grid_backward_points", "pqippippipi")
_adam = native.Function("multisampled_grid_adam", "ppppiippippppfddfi", "q")


def multisampled_grid_reference(points: Tensor, table: Tensor, layout: HashGridLayout) -> Tensor:
    """Compute `multisampled_grid` in PyTorch, for any device and float type, with derivatives of any order.

    Args:
        points: (N, J, 4) positions in [0, 1] and standard deviations.
        table: (E, F) entries of all levels.
        layout: resolutions and offsets of the levels.

    Returns:
        (N, L * F) features, level by level.
    """
    positions, deviations = points[..., :3].flatten(0, 1), points[..., 3].detach().flatten()
    shares = level_weights(deviations, points.new_tensor(layout.resolutions)).to(table.dtype)
    features = []
    for level, offset in enumerate(layout.offsets[:-1]):
        entries, weights, _ = corners(positions, layout, level)
        found = (table[entries.long() + offset] * (weights * shares[:, level])[..., None]).sum(0)
        features.append(found.view(*points.shape[:2], -1).mean(1))
    return torch.cat(features, dim=-1)


class MultisampleGradient(TableGradient):
    """The deferred gradient of a table that frustums are looked up in: see `TableGradient`.

    Its `parts` hold the points (N, J, 4) of each encoding, and the gradient (N, L * F) of its result.
    """

    _add, _adam = _backward_table, _adam

    def _arguments(self, features: int) -> tuple[Any, ...]:
        width, layout = self.layout.num_levels * features, (*self.layout.arrays, self.layout.num_levels)
        ends = tuple(accumulate(len(points) for points, _ in self.parts))
        each = tuple(points.shape[1] for points, _ in self.parts)
        points = [native.pointer(x, "points", (len(x), x.shape[1], 4)) for x, _ in self.parts]
        grads = [native.pointer(g, "the gradient", (len(x), width)) for x, g in self.parts]
        lists = native.pointers(points), native.pointers(grads), native.integers(ends), native.integers(each)
        return *lists, len(ends), features, *layout


class _MultisampledGrid(torch.autograd.Function):
    """The compiled form of `multisampled_grid`."""

    @staticmethod
    def forward(ctx: Any, points: Tensor, table: Tensor, placeholder: Tensor | None, layout: HashGridLayout) -> Tensor:
        (count, each, _), features = points.shape, table.shape[1]
        where = native.pointer(points, "points", (count, each, 4))
        entries = native.pointer(table, "the hash table", (layout.num_entries, features))

        def compute() -> Tensor:
            out = points.new_empty(count, layout.num_levels * features)
            _forward(
                where, count, each, entries, features, *layout.arrays, layout.num_levels, out.data_ptr(),
                native.threads(),
            )  # fmt: skip
            return out

        ctx.save_for_backward(points, table)
        ctx.layout = layout
        return kept.result(("multisampled_grid", layout), (points,), (table,), compute)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        points, table = ctx.saved_tensors
        layout, (count, each, _), features = ctx.layout, points.shape, table.shape[1]
        grad = grad.contiguous()
        incoming = native.pointer(grad, "the gradient", (count, layout.num_levels * features))
        grad_points = grad_table = None
        if ctx.needs_input_grad[1]:
            grad_table = torch.zeros_like(table)
            gradient = MultisampleGradient(layout)
            gradient.parts.append((points, grad))
            gradient.add_to(grad_table)
        if ctx.needs_input_grad[0]:
            grad_points = torch.empty_like(points)
            _backward_points(
                points.data_ptr(), count, each, table.data_ptr(), incoming, features, *layout.arrays,
                layout.num_levels, grad_points.data_ptr(), native.threads(),
            )  # fmt: skip
        return grad_points, grad_table, grad if ctx.needs_input_grad[2] else None, None


def multisampled_grid(
    points: Tensor, table: Tensor, layout: HashGridLayout, deferred: MultisampleGradient | None = None
) -> Tensor:
    """Return the hash encoding of frustums: the mean over their points of features that are weighted by scale.

    The compiled form has first derivatives only.

    Args:
        points: (N, J, 4) positions, clamped to [0, 1], and standard deviations in units of the cube, through which no
            gradient goes.
        table: (E, F) entries of all levels, E = layout.num_entries.
        layout: resolutions and offsets of the levels.
        deferred: collects the gradient of the table in the compiled form, instead of autograd; None for autograd.

    Returns:
        (N, L * F) features of the type of `table`, level by level.

    Raises:
        ValueError: if a shape does not fit the layout.
    """
    if points.ndim != 3 or points.shape[1] < 1 or points.shape[2] != 4:
        raise ValueError(f"multisampled_grid: points have shape {tuple(points.shape)}, not (N, J, 4)")
    if table.ndim != 2 or table.shape[0] != layout.num_entries:
        raise ValueError(f"multisampled_grid: the table has shape {tuple(table.shape)}, not ({layout.num_entries}, F)")
    points = points.to(table.dtype)
    return MULTISAMPLED_GRID((points, table), points, table, layout, deferred)


def _reference(points: Tensor, table: Tensor, layout: HashGridLayout, deferred: MultisampleGradient | None) -> Tensor:
    return multisampled_grid_reference(points, table, layout)


MULTISAMPLED_GRID = Operation("multisampled_grid", _reference)


def _fits(points: Tensor, table: Tensor, layout: HashGridLayout, deferred: MultisampleGradient | None) -> bool:
    return table.shape[1] in (1, 2, 4, 8)


@MULTISAMPLED_GRID.implementation(CPP, fits=_fits)
def _compiled(points: Tensor, table: Tensor, layout: HashGridLayout, deferred: MultisampleGradient | None) -> Tensor:
    points, table, placeholder = points.contiguous(), table.contiguous(), None
    if deferred is not None and table.requires_grad:
        placeholder = waiting(table, points, layout.num_levels * table.shape[1], deferred.parts)
        table = table.detach()
    return _MultisampledGrid.apply(points, table, placeholder, layout)
