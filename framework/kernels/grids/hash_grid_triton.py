"""Multiresolution hash encoding, in Triton. `nerfloom.kernels.grids.hash_grid` has the reference.

A program processes a block of positions at one level. The gradient of the table is accumulated by atomic operations:
except at the coarsest levels, the positions of a batch are spread over far more entries than there are processors. So
sums depend on the order of execution, by rounding errors.
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

from nerfloom.kernels.grids.hash_grid_layout import HashGridLayout
from nerfloom.kernels.grids.hash_grid_lookup import TableGradient
from nerfloom.kernels.triton_launch import blocks, launch, own_rows, store_three

BLOCK = 128
"""Positions per program."""
PRIME_Y, PRIME_Z = tl.constexpr(2654435761), tl.constexpr(805459861)


@functools.lru_cache(maxsize=16)
def _levels(layout: HashGridLayout, device: torch.device) -> Tensor:
    """Return resolution, first entry, hash mask, and 1 if dense (otherwise 0) of each level, (L, 4) int64."""
    rows = [
        (resolution, first, layout.offsets[level + 1] - first - 1, int(layout.is_dense(level)))
        for level, (resolution, first) in enumerate(zip(layout.resolutions, layout.offsets[:-1], strict=True))
    ]
    return torch.tensor(rows, device=device)


@triton.jit
def _level(levels, level):
    """Return a level's resolution, first entry, hash mask, and 1 if it is dense (otherwise 0)."""
    row = levels + level * 4
    return tl.load(row).to(tl.int32), tl.load(row + 1), tl.load(row + 2), tl.load(row + 3)


@triton.jit
def _along(positions, n, here, axis: tl.constexpr, resolution):
    """Return the cell along an axis, the position in it in [0, 1], and the derivative of the latter."""
    x = tl.load(positions + n * 3 + axis, mask=here, other=0.0)
    scaled = tl.where(x < 0, 0.0, tl.where(x > 1, 1.0, x)) * resolution.to(tl.float32)  # NaN stays
    cell = tl.minimum(tl.where(scaled == scaled, scaled, 0.0).to(tl.int32), resolution - 1)
    inside = tl.where((x < 0) | (x > 1), 0.0, resolution.to(tl.float32))
    return cell, scaled - cell.to(tl.float32), inside


@triton.jit
def _place(positions, n, here, resolution):
    """Return the cell along each axis, the position in it along each, and the derivatives of the latter."""
    x, u, inside_x = _along(positions, n, here, 0, resolution)
    y, v, inside_y = _along(positions, n, here, 1, resolution)
    z, w, inside_z = _along(positions, n, here, 2, resolution)
    return x, y, z, u, v, w, inside_x, inside_y, inside_z


@triton.jit
def _end(fraction, side: tl.constexpr):
    """Return the weight of one end of the cell along an axis."""
    weight = 1 - fraction
    if side == 1:
        weight = fraction
    return weight


@triton.jit
def _entry(x, y, z, corner: tl.constexpr, resolution, mask, dense):
    """Return the entry of a corner, counted from the level's first."""
    x, y, z = x + (corner >> 2 & 1), y + (corner >> 1 & 1), z + (corner & 1)
    row = (x * (resolution + 1) + y) * (resolution + 1) + z
    mixed = x.to(tl.uint32) ^ (y.to(tl.uint32) * PRIME_Y) ^ (z.to(tl.uint32) * PRIME_Z)
    return tl.where(dense != 0, row.to(tl.int64), mixed.to(tl.int64) & mask)


@triton.jit(do_not_specialize=["count"])
def _forward(positions, table, levels, out, count, num_levels, F: tl.constexpr, BLOCK: tl.constexpr):
    n, here = own_rows(count, BLOCK)
    level = tl.program_id(1)
    f = tl.arange(0, F)
    resolution, first, mask, dense = _level(levels, level)
    x, y, z, u, v, w, _, _, _ = _place(positions, n, here, resolution)
    total = tl.zeros([BLOCK, F], tl.float32)
    for corner in tl.static_range(8):
        weight = _end(u, corner >> 2 & 1) * _end(v, corner >> 1 & 1) * _end(w, corner & 1)
        entry = first + _entry(x, y, z, corner, resolution, mask, dense)
        values = tl.load(table + entry[:, None] * F + f[None, :], mask=here[:, None], other=0.0)
        total += weight[:, None] * values
    to = out + (n[:, None] * num_levels + level) * F + f[None, :]
    tl.store(to, total, mask=here[:, None])


@triton.jit(do_not_specialize=["count"])
def _backward_table(positions, grad, levels, of_table, count, num_levels, F: tl.constexpr, BLOCK: tl.constexpr):
    n, here = own_rows(count, BLOCK)
    level = tl.program_id(1)
    f = tl.arange(0, F)
    resolution, first, mask, dense = _level(levels, level)
    x, y, z, u, v, w, _, _, _ = _place(positions, n, here, resolution)
    g = tl.load(grad + (n[:, None] * num_levels + level) * F + f[None, :], mask=here[:, None], other=0.0)
    some = here[:, None] & (g != 0)  # hidden samples have no gradient and need no writing
    for corner in tl.static_range(8):
        weight = _end(u, corner >> 2 & 1) * _end(v, corner >> 1 & 1) * _end(w, corner & 1)
        entry = first + _entry(x, y, z, corner, resolution, mask, dense)
        tl.atomic_add(of_table + entry[:, None] * F + f[None, :], weight[:, None] * g, mask=some, sem="relaxed")


@triton.jit(do_not_specialize=["count"])
def _backward_positions(
    positions, table, grad, levels, of_positions, count, num_levels, F: tl.constexpr, BLOCK: tl.constexpr
):
    n, here = own_rows(count, BLOCK)
    f = tl.arange(0, F)
    of_x = tl.zeros([BLOCK], tl.float32)
    of_y = tl.zeros([BLOCK], tl.float32)
    of_z = tl.zeros([BLOCK], tl.float32)
    for level in range(num_levels):
        resolution, first, mask, dense = _level(levels, level)
        x, y, z, u, v, w, inside_x, inside_y, inside_z = _place(positions, n, here, resolution)
        g = tl.load(grad + (n[:, None] * num_levels + level) * F + f[None, :], mask=here[:, None], other=0.0)
        for corner in tl.static_range(8):
            entry = first + _entry(x, y, z, corner, resolution, mask, dense)
            values = tl.load(table + entry[:, None] * F + f[None, :], mask=here[:, None], other=0.0)
            value = tl.sum(values * g, 1)
            along_x, along_y, along_z = _end(u, corner >> 2 & 1), _end(v, corner >> 1 & 1), _end(w, corner & 1)
            of_x += (2 * (corner >> 2 & 1) - 1) * inside_x * along_y * along_z * value
            of_y += (2 * (corner >> 1 & 1) - 1) * inside_y * along_x * along_z * value
            of_z += (2 * (corner & 1) - 1) * inside_z * along_x * along_y * value
    store_three(of_positions + n * 3, of_x, of_y, of_z, here)


class _HashGrid(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, positions: Tensor, table: Tensor, layout: HashGridLayout) -> Tensor:
        count, features, levels = len(positions), table.shape[1], _levels(layout, positions.device)
        out = positions.new_empty(count, layout.num_levels * features)
        launch(
            _forward, (blocks(count, BLOCK), layout.num_levels), positions, table, levels, out, count,
            layout.num_levels, F=features, BLOCK=BLOCK,
        )  # fmt: skip
        ctx.save_for_backward(positions, table, levels)
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        positions, table, levels = ctx.saved_tensors
        count, constants, grad = len(positions), {"F": table.shape[1], "BLOCK": BLOCK}, grad.contiguous()
        of_positions = of_table = None
        if ctx.needs_input_grad[1]:
            of_table = torch.zeros_like(table)
            programs = blocks(count, BLOCK), len(levels)
            launch(_backward_table, programs, positions, grad, levels, of_table, count, len(levels), **constants)
        if ctx.needs_input_grad[0]:
            of_positions = torch.empty_like(positions)
            launch(
                _backward_positions, (blocks(count, BLOCK),), positions, table, grad, levels, of_positions, count,
                len(levels), **constants,
            )  # fmt: skip
        return of_positions, of_table, None


def hash_grid(positions: Tensor, table: Tensor, layout: HashGridLayout, deferred: TableGradient | None) -> Tensor:
    """Compute `hash_grid` of `positions`, `table` and `layout`; autograd has the gradient instead of `deferred`."""
    return _HashGrid.apply(positions.contiguous(), table.contiguous(), layout)
