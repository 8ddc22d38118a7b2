"""Factorised features, in Triton. `nerfloom.kernels.grids.planes` has the reference.

A program processes a block of positions in one group of factors, with all features. The gradient of the table is
accumulated by atomic operations, so its rounding errors depend on the order of execution.
"""

# mypy: allow-untyped-defs, allow-untyped-decorators, allow-incomplete-defs
# Triton gives the kernels' arguments their types.

from __future__ import annotations

import functools
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from nerfloom.kernels.grids.planes import PlanesGradient
from nerfloom.kernels.grids.planes_layout import PlanesLayout
from nerfloom.kernels.triton_launch import blocks, launch, own_rows

BLOCK = 32
"""Positions per program."""


@functools.lru_cache(maxsize=16)
def _factors(layout: PlanesLayout, device: torch.device) -> Tensor:
    """Return both axes, vertices along both, entries to the next row, and first entry of each factor, (G, P, 6) int64.

    A line has its axis twice, the second time with one vertex and no next row.
    """
    rows = []
    for sizes, group, firsts in zip(layout.resolutions, layout.axes, layout.offsets, strict=True):
        for along, first in zip(group, firsts, strict=True):
            one, two, across = along[0], along[-1], sizes[along[0]]
            rows.append([one, two, across, *((1, 0) if len(along) == 1 else (sizes[two], across)), first])
    return torch.tensor(rows, device=device).view(layout.num_groups, -1, 6)


@triton.jit
def _along(positions, n, here, dims, axis, size):
    """Return the cell along an axis, the position in it in [0, 1], and the derivative of the latter."""
    x = tl.load(positions + n * dims + axis, mask=here, other=0.0)
    cells = (size - 1).to(tl.float32)
    scaled = tl.where(x < 0, 0.0, tl.where(x > 1, 1.0, x)) * cells  # NaN stays
    cell = tl.minimum(tl.where(scaled == scaled, scaled, 0.0).to(tl.int64), tl.maximum(size - 2, 0))
    inside = tl.where((x < 0) | (x > 1), 0.0, cells)
    return cell, scaled - cell.to(tl.float32), inside


@triton.jit
def _corner(positions, factor, n, here, dims):
    """Return the entry of a cell's first corner, the entries to the row above, and `_along` of both axes."""
    i, a, inside_a = _along(positions, n, here, dims, tl.load(factor), tl.load(factor + 2))
    j, b, inside_b = _along(positions, n, here, dims, tl.load(factor + 1), tl.load(factor + 3))
    row = tl.load(factor + 4)
    return tl.load(factor + 5) + j * row + i, row, a, b, inside_a, inside_b


@triton.jit
def _value(positions, table, factor, n, f, dims, features, mask, here):
    """Return the features (positions, features) of a factor."""
    first, row, a, b, _, _ = _corner(positions, factor, n, here, dims)
    low = table + first[:, None] * features + f[None, :]
    high = low + row * features
    a, b = a[:, None], b[:, None]
    below = tl.load(low, mask=mask, other=0.0) * (1 - a) + tl.load(low + features, mask=mask, other=0.0) * a
    above = tl.load(high, mask=mask, other=0.0) * (1 - a) + tl.load(high + features, mask=mask, other=0.0) * a
    return below * (1 - b) + above * b


@triton.jit(do_not_specialize=["count"])
def _forward(
    positions, table, factors, out, count, dims, features, groups, P: tl.constexpr, F: tl.constexpr, BLOCK: tl.constexpr
):
    n, here = own_rows(count, BLOCK)
    group = tl.program_id(1)
    f = tl.arange(0, F)
    mask = here[:, None] & (f < features)[None, :]
    product = tl.full([BLOCK, F], 1.0, tl.float32)
    for p in range(P):
        factor = factors + (group * P + p) * 6
        product *= _value(positions, table, factor, n, f, dims, features, mask, here)
    tl.store(out + (n[:, None] * groups + group) * features + f[None, :], product, mask=mask)


@triton.jit
def _others(positions, table, grad, factors, n, f, dims, features, mask, here, p, P: tl.constexpr):
    """Return the incoming gradient times the features of all factors of a group except factor `p`."""
    product = grad
    for q in range(P):
        if q != p:
            product *= _value(positions, table, factors + q * 6, n, f, dims, features, mask, here)
    return product


@triton.jit(do_not_specialize=["count"])
def _backward_table(
    positions, table, grad, factors, of_table, count, dims, features, groups, P: tl.constexpr, F: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    n, here = own_rows(count, BLOCK)
    group = tl.program_id(1)
    f = tl.arange(0, F)
    mask = here[:, None] & (f < features)[None, :]
    g = tl.load(grad + (n[:, None] * groups + group) * features + f[None, :], mask=mask, other=0.0)
    mask &= g != 0  # hidden samples have no gradient and need no reading
    factors += group * P * 6
    for p in range(P):
        own = _others(positions, table, g, factors, n, f, dims, features, mask, here, p, P)
        first, row, a, b, _, _ = _corner(positions, factors + p * 6, n, here, dims)
        low = of_table + first[:, None] * features + f[None, :]
        a, b = a[:, None], b[:, None]
        tl.atomic_add(low, own * (1 - a) * (1 - b), mask=mask, sem="relaxed")
        tl.atomic_add(low + features, own * a * (1 - b), mask=mask, sem="relaxed")
        upper = mask & (b != 0)  # a line has no row above
        high = low + row * features
        tl.atomic_add(high, own * (1 - a) * b, mask=upper, sem="relaxed")
        tl.atomic_add(high + features, own * a * b, mask=upper, sem="relaxed")


@triton.jit(do_not_specialize=["count"])
def _backward_positions(
    positions, table, grad, factors, of_positions, count, dims, features, groups, P: tl.constexpr, F: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    n, here = own_rows(count, BLOCK)
    f, axes = tl.arange(0, F), tl.arange(0, 4)
    mask = here[:, None] & (f < features)[None, :]
    total = tl.zeros([BLOCK, 4], tl.float32)
    for group in range(groups):
        g = tl.load(grad + (n[:, None] * groups + group) * features + f[None, :], mask=mask, other=0.0)
        of_group = factors + group * P * 6
        for p in range(P):
            own = _others(positions, table, g, of_group, n, f, dims, features, mask, here, p, P)
            factor = of_group + p * 6
            first, row, a, b, inside_a, inside_b = _corner(positions, factor, n, here, dims)
            low = table + first[:, None] * features + f[None, :]
            high = low + row * features
            one, two = tl.load(low, mask=mask, other=0.0), tl.load(low + features, mask=mask, other=0.0)
            three, four = tl.load(high, mask=mask, other=0.0), tl.load(high + features, mask=mask, other=0.0)
            a, b = a[:, None], b[:, None]
            along_a = tl.sum(own * ((two - one) * (1 - b) + (four - three) * b), 1) * inside_a
            along_b = tl.sum(own * ((three - one) * (1 - a) + (four - two) * a), 1) * inside_b
            total += tl.where(axes[None, :] == tl.load(factor), along_a[:, None], 0.0)
            total += tl.where(axes[None, :] == tl.load(factor + 1), along_b[:, None], 0.0)
    to = of_positions + n[:, None] * dims + axes[None, :]
    tl.store(to, total, mask=here[:, None] & (axes < dims)[None, :])


class _Planes(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, positions: Tensor, table: Tensor, layout: PlanesLayout) -> Tensor:
        factors = _factors(layout, positions.device)
        count, features, groups = len(positions), table.shape[1], layout.num_groups
        out = positions.new_empty(count, groups * features)
        sizes = count, layout.dims, features, groups
        constants = {"P": len(layout.axes[0]), "F": triton.next_power_of_2(features), "BLOCK": BLOCK}
        launch(_forward, (blocks(count, BLOCK), groups), positions, table, factors, out, *sizes, **constants)
        ctx.save_for_backward(positions, table, factors)
        ctx.settings = sizes, constants
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        positions, table, factors = ctx.saved_tensors
        grad, (sizes, constants) = grad.contiguous(), ctx.settings
        of_positions = of_table = None
        programs = blocks(len(positions), BLOCK)
        if ctx.needs_input_grad[0]:
            of_positions = torch.empty_like(positions)
            launch(_backward_positions, (programs,), positions, table, grad, factors, of_positions, *sizes, **constants)
        if ctx.needs_input_grad[1]:
            of_table = torch.zeros_like(table)
            launch(
                _backward_table, (programs, sizes[-1]), positions, table, grad, factors, of_table, *sizes, **constants
            )
        return of_positions, of_table, None


def planes(positions: Tensor, table: Tensor, layout: PlanesLayout, deferred: PlanesGradient | None) -> Tensor:
    """Compute `planes.planes` of `positions`, `table` and `layout`; autograd has the gradient instead of `deferred`."""
    return _Planes.apply(positions.contiguous(), table.contiguous(), layout)
