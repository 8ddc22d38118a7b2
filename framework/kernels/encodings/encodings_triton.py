"""Encodings without parameters, and the contraction of space, in Triton.

`nerfloom.kernels.encodings.spherical_harmonics`, `frequency` and `contraction` have the references.
"""

# Triton gives the kernels' arguments their types.
# mypy: allow-untyped-defs, allow-untyped-decorators, allow-incomplete-defs

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from nerfloom.kernels.encodings.harmonics_triton import harmonics
from nerfloom.kernels.triton_launch import MAX_FLOAT, blocks, launch, load_three, own_rows, store_three

BLOCK = 256
"""Rows, or values, per program."""


@triton.jit(do_not_specialize=["count"])
def _harmonics(directions, out, count, WIDTH: tl.constexpr, BLOCK: tl.constexpr):
    n, here = own_rows(count, BLOCK)
    x, y, z = load_three(directions + n * 3, here)
    tl.store(out + n * WIDTH, tl.full([BLOCK], 0.28209479177387814, tl.float32), mask=here)
    for k in tl.static_range(1, WIDTH):
        tl.store(out + n * WIDTH + k, harmonics(x, y, z, k), mask=here)


def spherical_harmonics(directions: Tensor, levels: int = 4) -> Tensor:
    """Compute `spherical_harmonics.spherical_harmonics` of `directions` and `levels`, without derivatives."""
    directions, count = directions.contiguous(), len(directions)
    out = directions.new_empty(count, levels**2)
    launch(_harmonics, (blocks(count, BLOCK),), directions, out, count, WIDTH=levels**2, BLOCK=BLOCK)
    return out


@triton.jit(do_not_specialize=["count"])
def _waves(x, out, count, dims, first, width, BLOCK: tl.constexpr):
    i, here = own_rows(count, BLOCK)  # a value of the result
    n, column = i // width, i % width
    wave = tl.maximum(column - first, 0)
    k, part = wave // (2 * dims), wave % (2 * dims)
    d = tl.where(column < first, column, part % dims)
    value = tl.load(x + n * dims + d, mask=here, other=0.0)
    scale = ((k + 127) << 23).to(tl.int32).to(tl.float32, bitcast=True)  # 2^k, exactly
    angle = value * scale
    wave_value = tl.where(part < dims, tl.sin(angle), tl.cos(angle))
    tl.store(out + i, tl.where(column < first, value, wave_value), mask=here)


@triton.jit(do_not_specialize=["count"])
def _waves_backward(rows, grad, of_x, count, dims, first, width, num_frequencies, BLOCK: tl.constexpr):
    i, here = own_rows(count, BLOCK)  # a value of the input
    n, d = i // dims, i % dims
    total = tl.load(grad + n * width + d, mask=here & (d < first), other=0.0)
    at, scale = n * width + first + d, 1.0
    for _ in range(num_frequencies):
        sine, cosine = tl.load(rows + at, mask=here, other=0.0), tl.load(rows + at + dims, mask=here, other=0.0)
        of_sine, of_cosine = tl.load(grad + at, mask=here, other=0.0), tl.load(grad + at + dims, mask=here, other=0.0)
        total += scale * (cosine * of_sine - sine * of_cosine)
        at += 2 * dims
        scale *= 2.0
    tl.store(of_x + i, total, mask=here)


class _Frequency(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, num_frequencies: int, include_input: bool) -> Tensor:
        count, dims = x.shape
        first = dims * include_input
        width = first + 2 * dims * num_frequencies
        out = x.new_empty(count, width)
        launch(_waves, (blocks(count * width, BLOCK),), x, out, count * width, dims, first, width, BLOCK=BLOCK)
        ctx.save_for_backward(out)
        ctx.settings = dims, first, width, num_frequencies
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:
        (rows,) = ctx.saved_tensors
        count = len(rows) * ctx.settings[0]
        of_x = rows.new_empty(len(rows), ctx.settings[0])
        programs = (blocks(count, BLOCK),)
        launch(_waves_backward, programs, rows, grad.contiguous(), of_x, count, *ctx.settings, BLOCK=BLOCK)
        return of_x, None, None


def frequency_encoding(x: Tensor, num_frequencies: int, include_input: bool = True) -> Tensor:
    """Compute `frequency.frequency_encoding` of `x`, `num_frequencies` and `include_input`, with first derivatives."""
    rows = x.flatten(0, -2).contiguous()
    return _Frequency.apply(rows, num_frequencies, include_input).unflatten(0, x.shape[:-1])


@triton.jit
def _place(positions, centre, scale, n, here, axis: tl.constexpr):
    """Return the position along an axis from the centre in half edges; infinity has no direction."""
    x = tl.load(positions + n * 3 + axis, mask=here, other=0.0)
    x = (x - tl.load(centre + axis)) * tl.load(scale + axis)
    return tl.where(x > MAX_FLOAT, MAX_FLOAT, tl.where(x < -MAX_FLOAT, -MAX_FLOAT, x))


@triton.jit
def _contracted(positions, centre, scale, n, here):
    """Return x, y and z, their unit, max(1, norm) in that unit, and the factor that contracts them.

    The unit is 1, except far away, where squares would overflow: there it is a power of two that scales everything
    down.
    """
    x = _place(positions, centre, scale, n, here, 0)
    y = _place(positions, centre, scale, n, here, 1)
    z = _place(positions, centre, scale, n, here, 2)
    farthest = tl.maximum(tl.maximum(tl.abs(x), tl.abs(y)), tl.abs(z))
    unit = tl.where(farthest > 1e12, 1.0339757656912846e-25, 1.0)  # 2^-83: from 1e12 to 3e38 becomes from 1e-13 to 4e13
    x, y, z = x * unit, y * unit, z * unit
    norm = tl.sqrt(x * x + y * y + z * z)
    norm = tl.where(norm < unit, unit, norm)  # NaN stays
    return x, y, z, unit, norm, (2 * norm - unit) / norm / norm


@triton.jit(do_not_specialize=["count"])
def _contract(positions, centre, scale, out, count, BLOCK: tl.constexpr):
    n, here = own_rows(count, BLOCK)
    x, y, z, _, _, factor = _contracted(positions, centre, scale, n, here)
    store_three(out + n * 3, 0.25 * x * factor + 0.5, 0.25 * y * factor + 0.5, 0.25 * z * factor + 0.5, here)


@triton.jit(do_not_specialize=["count"])
def _contract_backward(positions, centre, scale, grad, out, count, BLOCK: tl.constexpr):
    # With n = max(1, |x|) and y = x s(n), s(n) = 2/n - 1/n^2:  J^T g = s g + x (x . g) s'(n) / n. The second term is 0
    # if n is 1.
    n, here = own_rows(count, BLOCK)
    x, y, z, unit, norm, factor = _contracted(positions, centre, scale, n, here)
    of_x, of_y, of_z = load_three(grad + n * 3, here)
    along = (x * of_x + y * of_y + z * of_z) / norm
    radial = along * ((2 * unit / norm - 2) / norm / norm)
    over = 0.25 * unit
    x = over * tl.load(scale) * (factor * of_x + radial * x)
    y = over * tl.load(scale + 1) * (factor * of_y + radial * y)
    z = over * tl.load(scale + 2) * (factor * of_z + radial * z)
    store_three(out + n * 3, x, y, z, here)


class _Contract(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, positions: Tensor, box: Tensor) -> Tensor:
        centre, scale = (box[0] + box[1]) / 2, 2 / (box[1] - box[0])
        count, out = len(positions), torch.empty_like(positions)
        launch(_contract, (blocks(count, BLOCK),), positions, centre, scale, out, count, BLOCK=BLOCK)
        ctx.save_for_backward(positions, centre, scale)
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        positions, centre, scale = ctx.saved_tensors
        count, out, programs = len(positions), torch.empty_like(positions), (blocks(len(positions), BLOCK),)
        launch(_contract_backward, programs, positions, centre, scale, grad.contiguous(), out, count, BLOCK=BLOCK)
        return out, None


def contract_to_unit(positions: Tensor, box: Tensor) -> Tensor:
    """Compute `contraction.contract_to_unit` of `positions` and `box`, with the gradient of the positions."""
    return _Contract.apply(positions.contiguous(), box)
