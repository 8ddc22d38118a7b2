"""Integrated directional encoding, in Triton. `integrated_directional.py` has the reference and the recurrence.

A kernel takes one order m after the other. Q_l^m = P_l^m / P_m^m follows the recurrence of P_l^m and starts with 1;
P_m^m is a factor of the powers of x + i y instead.
"""

# Triton gives the kernels' arguments their types.
# mypy: allow-untyped-defs, allow-untyped-decorators, allow-incomplete-defs

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from nerfloom.kernels.encodings.integrated_directional import MAX_BANDS, degrees, num_features
from nerfloom.kernels.triton_launch import blocks, launch, load_three, own_rows, store_three

BLOCK = 128
"""Directions per program."""


@triton.jit(do_not_specialize=["count"])
def _forward(directions, roughness, out, count, WIDTH: tl.constexpr, LAST: tl.constexpr, BLOCK: tl.constexpr):
    n, here = own_rows(count, BLOCK)
    x, y, z = load_three(directions + n * 3, here)
    rough = tl.load(roughness + n, mask=here, other=0.0)
    to = out + n * WIDTH
    real = tl.full([BLOCK], 0.28209479177387814, tl.float32)  # P_m^m times the power m of x + i y
    imaginary = tl.zeros([BLOCK], tl.float32)
    for m in tl.static_range(LAST + 1):
        if m > 0:
            factor = -(((2 * m + 1) / (2 * m)) ** 0.5)
            real, imaginary = factor * (x * real - y * imaginary), factor * (x * imaginary + y * real)
        before = tl.zeros([BLOCK], tl.float32)
        row = tl.full([BLOCK], 1.0, tl.float32)
        for degree in tl.static_range(m, LAST + 1):
            if degree > m:
                a = ((4 * degree * degree - 1) / (degree * degree - m * m)) ** 0.5
                b = (((degree - 1) * (degree - 1) - m * m) / (4 * (degree - 1) * (degree - 1) - 1)) ** 0.5
                before, row = row, a * (z * row - b * before)
            if degree > 0 and (degree & (degree - 1)) == 0:  # a band
                middle = 3 * degree - 2 + (degree > 1) + (degree > 2) + (degree > 4) + (degree > 8)  # its m = 0
                kept = tl.exp(rough * (-0.5 * degree * (degree + 1))) * row
                if m == 0:
                    tl.store(to + middle, kept * real, mask=here)
                if m > 0:
                    tl.store(to + middle + m, 1.4142135623730951 * kept * real, mask=here)
                    tl.store(to + middle - m, 1.4142135623730951 * kept * imaginary, mask=here)


@triton.jit(do_not_specialize=["count"])
def _backward(
    directions, roughness, grad, of_directions, of_roughness, count, WIDTH: tl.constexpr, LAST: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    n, here = own_rows(count, BLOCK)
    x, y, z = load_three(directions + n * 3, here)
    rough = tl.load(roughness + n, mask=here, other=0.0)
    given = grad + n * WIDTH
    of_x = tl.zeros([BLOCK], tl.float32)
    of_y = tl.zeros([BLOCK], tl.float32)
    of_z = tl.zeros([BLOCK], tl.float32)
    of_rough = tl.zeros([BLOCK], tl.float32)
    real = tl.full([BLOCK], 0.28209479177387814, tl.float32)
    imaginary = tl.zeros([BLOCK], tl.float32)
    slope_real = tl.zeros([BLOCK], tl.float32)  # of the power by x; by y it is i times as much
    slope_imaginary = tl.zeros([BLOCK], tl.float32)
    for m in tl.static_range(LAST + 1):
        if m > 0:
            factor = -(((2 * m + 1) / (2 * m)) ** 0.5)
            slope_real, slope_imaginary = m * factor * real, m * factor * imaginary
            real, imaginary = factor * (x * real - y * imaginary), factor * (x * imaginary + y * real)
        before = tl.zeros([BLOCK], tl.float32)
        row = tl.full([BLOCK], 1.0, tl.float32)
        slope_before = tl.zeros([BLOCK], tl.float32)  # of Q by z
        slope = tl.zeros([BLOCK], tl.float32)
        for degree in tl.static_range(m, LAST + 1):
            if degree > m:
                a = ((4 * degree * degree - 1) / (degree * degree - m * m)) ** 0.5
                b = (((degree - 1) * (degree - 1) - m * m) / (4 * (degree - 1) * (degree - 1) - 1)) ** 0.5
                slope_before, slope = slope, a * (row + z * slope - b * slope_before)
                before, row = row, a * (z * row - b * before)
            if degree > 0 and (degree & (degree - 1)) == 0:
                middle = 3 * degree - 2 + (degree > 1) + (degree > 2) + (degree > 4) + (degree > 8)
                rate = -0.5 * degree * (degree + 1)
                kept = tl.exp(rough * rate)
                if m == 0:
                    along = tl.load(given + middle, mask=here, other=0.0) * real
                    of_z += kept * slope * along
                    of_rough += rate * kept * row * along
                if m > 0:
                    by_real = 1.4142135623730951 * tl.load(given + middle + m, mask=here, other=0.0)
                    by_imaginary = 1.4142135623730951 * tl.load(given + middle - m, mask=here, other=0.0)
                    along = by_real * real + by_imaginary * imaginary
                    of_z += kept * slope * along
                    of_rough += rate * kept * row * along
                    of_x += kept * row * (by_real * slope_real + by_imaginary * slope_imaginary)
                    of_y += kept * row * (by_imaginary * slope_real - by_real * slope_imaginary)
    store_three(of_directions + n * 3, of_x, of_y, of_z, here)
    tl.store(of_roughness + n, of_rough, mask=here)


class _DirectionalEncoding(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, directions: Tensor, roughness: Tensor, bands: int) -> Tensor:
        count, width, last = len(directions), num_features(bands), degrees(bands)[-1]
        out, programs = directions.new_empty(count, width), (blocks(count, BLOCK),)
        launch(_forward, programs, directions, roughness, out, count, WIDTH=width, LAST=last, BLOCK=BLOCK)
        ctx.save_for_backward(directions, roughness)
        ctx.bands = bands
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, None]:
        directions, roughness = ctx.saved_tensors
        count, width, last = len(directions), num_features(ctx.bands), degrees(ctx.bands)[-1]
        outs, programs = (torch.empty_like(directions), torch.empty_like(roughness)), (blocks(count, BLOCK),)
        given = directions, roughness, grad.contiguous(), *outs
        launch(_backward, programs, *given, count, WIDTH=width, LAST=last, BLOCK=BLOCK)
        return *outs, None


def directional_encoding(directions: Tensor, roughness: Tensor, bands: int = MAX_BANDS) -> Tensor:
    """Compute `directional_encoding` of `directions`, `roughness` and `bands`, with first derivatives."""
    found: Tensor = _DirectionalEncoding.apply(directions.contiguous(), roughness.contiguous(), bands)
    return found
