"""A network on a hash grid with the gradient of its first output, in Triton. `distance.py` has the reference.

Look-ups are kernels; the products of the small network are torch's.
"""

# mypy: allow-untyped-defs, allow-untyped-decorators, allow-incomplete-defs
# Triton gives the kernels' arguments their types.

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from nerfloom.kernels.grids.hash_grid_layout import HashGridLayout
from nerfloom.kernels.grids.hash_grid_lookup import TableGradient
from nerfloom.kernels.grids.hash_grid_triton import (
    BLOCK,
    _backward_positions,
    _end,
    _entry,
    _forward,
    _level,
    _levels,
    _place,
)
from nerfloom.kernels.triton_launch import blocks, launch, load_three, own_rows


@triton.jit
def _slope(u, v, w, du, dv, dw, corner: tl.constexpr):
    """Return the derivative of a corner's weight, from positions in the cell and their derivatives."""
    along_x, along_y, along_z = _end(u, corner >> 2 & 1), _end(v, corner >> 1 & 1), _end(w, corner & 1)
    of_x, of_y, of_z = du * along_y * along_z, dv * along_x * along_z, dw * along_x * along_y
    return (2 * (corner >> 2 & 1) - 1) * of_x + (2 * (corner >> 1 & 1) - 1) * of_y + (2 * (corner & 1) - 1) * of_z


@triton.jit
def _moving(positions, directions, n, here, resolution):
    """Return the cell along each axis, the position in it along each, and their derivatives along the directions."""
    x, y, z, u, v, w, inside_x, inside_y, inside_z = _place(positions, n, here, resolution)
    dx, dy, dz = load_three(directions + n * 3, here)
    return x, y, z, u, v, w, inside_x * dx, inside_y * dy, inside_z * dz


@triton.jit(do_not_specialize=["count"])
def _tangent(
    positions, directions, table, levels, value, slope, count, num_levels, F: tl.constexpr, BLOCK: tl.constexpr
):
    n, here = own_rows(count, BLOCK)
    level = tl.program_id(1)
    f = tl.arange(0, F)
    resolution, first, mask, dense = _level(levels, level)
    x, y, z, u, v, w, du, dv, dw = _moving(positions, directions, n, here, resolution)
    values = tl.zeros([BLOCK, F], tl.float32)
    slopes = tl.zeros([BLOCK, F], tl.float32)
    for corner in tl.static_range(8):
        weight = _end(u, corner >> 2 & 1) * _end(v, corner >> 1 & 1) * _end(w, corner & 1)
        entry = first + _entry(x, y, z, corner, resolution, mask, dense)
        entries = tl.load(table + entry[:, None] * F + f[None, :], mask=here[:, None], other=0.0)
        values += weight[:, None] * entries
        slopes += _slope(u, v, w, du, dv, dw, corner)[:, None] * entries
    to = (n[:, None] * num_levels + level) * F + f[None, :]
    tl.store(value + to, values, mask=here[:, None])
    tl.store(slope + to, slopes, mask=here[:, None])


@triton.jit(do_not_specialize=["count"])
def _backward_both(
    positions, directions, of_value, of_slope, levels, of_table, count, num_levels, F: tl.constexpr, BLOCK: tl.constexpr
):
    n, here = own_rows(count, BLOCK)
    level = tl.program_id(1)
    f = tl.arange(0, F)
    resolution, first, mask, dense = _level(levels, level)
    x, y, z, u, v, w, du, dv, dw = _moving(positions, directions, n, here, resolution)
    at = (n[:, None] * num_levels + level) * F + f[None, :]
    by_value = tl.load(of_value + at, mask=here[:, None], other=0.0)
    by_slope = tl.load(of_slope + at, mask=here[:, None], other=0.0)
    for corner in tl.static_range(8):
        weight = _end(u, corner >> 2 & 1) * _end(v, corner >> 1 & 1) * _end(w, corner & 1)
        entry = first + _entry(x, y, z, corner, resolution, mask, dense)
        grad = weight[:, None] * by_value + _slope(u, v, w, du, dv, dw, corner)[:, None] * by_slope
        some = here[:, None] & (grad != 0)
        tl.atomic_add(of_table + entry[:, None] * F + f[None, :], grad, mask=some, sem="relaxed")


class _DistanceNetwork(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, positions: Tensor, table: Tensor, first: Tensor, second: Tensor, layout: HashGridLayout
    ) -> Tensor:
        count, features, levels = len(positions), table.shape[1], _levels(layout, positions.device)
        sizes, constants = (count, layout.num_levels), {"F": features, "BLOCK": BLOCK}
        encoded, gradient = positions.new_empty(count, first.shape[1]), torch.empty_like(positions)
        launch(_forward, (blocks(count, BLOCK), len(levels)), positions, table, levels, encoded, *sizes, **constants)
        hidden = encoded @ first.t()
        outward = ((hidden > 0) * second[0]) @ first
        launch(
            _backward_positions, (blocks(count, BLOCK),), positions, table, outward, levels, gradient, *sizes,
            **constants,
        )  # fmt: skip
        ctx.save_for_backward(positions, table, first, second, levels)
        return torch.cat([hidden.relu() @ second.t(), gradient], dim=-1)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        positions, table, first, second, levels = ctx.saved_tensors
        count, constants = len(positions), {"F": table.shape[1], "BLOCK": BLOCK}
        of_outputs, directions = grad[:, :-3], grad[:, -3:].contiguous()
        value, slope = (positions.new_empty(count, first.shape[1]) for _ in range(2))
        programs, sizes = (blocks(count, BLOCK), len(levels)), (count, len(levels))
        launch(_tangent, programs, positions, directions, table, levels, value, slope, *sizes, **constants)
        hidden = value @ first.t()
        active = hidden > 0
        outward, of_hidden = active * second[0], active * (of_outputs @ second)
        of_second = of_outputs.t() @ hidden.relu()
        of_second[0] += (active * (slope @ first.t())).sum(0)
        of_first = of_hidden.t() @ value + outward.t() @ slope
        of_table = None
        if ctx.needs_input_grad[1]:
            of_table, of_value, of_slope = torch.zeros_like(table), of_hidden @ first, outward @ first
            launch(
                _backward_both, programs, positions, directions, of_value, of_slope, levels, of_table, *sizes,
                **constants,
            )  # fmt: skip
        return None, of_table, of_first, of_second, None


def distance_network(
    positions: Tensor, table: Tensor, first: Tensor, second: Tensor, layout: HashGridLayout,
    deferred: TableGradient | None,
) -> Tensor:  # fmt: skip
    """Compute `distance_network` of `positions`, `table`, `first`, `second` and `layout`; `deferred` is not used."""
    with torch.autocast(positions.device.type, enabled=False):
        contiguous = positions.contiguous(), table.contiguous(), first.contiguous(), second.contiguous()
        return _DistanceNetwork.apply(*contiguous, layout)
