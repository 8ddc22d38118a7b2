"""Launch of kernels, and functions they share: rows of a program, optical depth, opacity without cancellation.

Sizes are passed as numbers, not as constants of the kernel, and Triton is told not to specialise on their values. So a
kernel is compiled once for all numbers of rays or samples. Constants are a method's sizes, such as the number of
features, and block sizes.
"""

# Triton gives the kernels' arguments their types.
# mypy: allow-untyped-defs, allow-untyped-decorators, allow-incomplete-defs

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

MAX_OPTICAL_DEPTH = tl.constexpr(1e3)
MAX_FLOAT = tl.constexpr(3.4028234663852886e38)


def launch(kernel: Any, programs: tuple[int, ...], first: Tensor, *arguments: Any, **constants: Any) -> None:
    """Launch a kernel on the device of its first argument; does nothing if there is no work.

    Args:
        kernel: the kernel.
        programs: number of programs along each axis of the grid.
        first: first argument of the kernel.
        arguments: all other arguments: contiguous tensors on the same device, numbers, or None.
        constants: constants of the kernel, and options of Triton such as `num_warps`.
    """
    if 0 in programs:
        return
    with torch.cuda.device_of(first):
        kernel[programs](first, *arguments, enable_fp_fusion=True, **constants)


def on_device(value: float | Tensor, like: Tensor) -> Tensor:
    """Return a number that changes from step to step as kernels read it, () float32, without a wait for the device.

    Args:
        value: the number, or a tensor () that holds it.
        like: a tensor on the device.
    """
    if isinstance(value, Tensor):
        return value.to(torch.float32)
    return torch.full((), value, dtype=torch.float32, device=like.device)


def blocks(count: int, size: int) -> int:
    """Return the number of blocks of `size` items that hold `count` items."""
    return -(-count // size)


@triton.jit
def own_rows(count, BLOCK: tl.constexpr):
    """Return the numbers, int64, of the `BLOCK` rows that this program processes, and whether each is below `count`."""
    n = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    return n, n < count


@triton.jit
def load_three(row, here):
    """Return the values at the addresses `row` and the two after each, 0 where not `here`."""
    x, y = tl.load(row, mask=here, other=0.0), tl.load(row + 1, mask=here, other=0.0)
    return x, y, tl.load(row + 2, mask=here, other=0.0)


@triton.jit
def store_three(row, x, y, z, here):
    """Write `x`, `y` and `z` to the addresses `row` and the two after each, where `here`."""
    tl.store(row, x, mask=here)
    tl.store(row + 1, y, mask=here)
    tl.store(row + 2, z, mask=here)


@triton.jit
def opacity_of(tau):
    """Return 1 - exp(-tau) for tau of at least 0; NaN stays NaN.

    Args:
        tau: optical depths.
    """
    # Below 1/2 by the series, because subtracting from 1 would lose all of tau below 6e-8.
    series = 1 - tau * (1 / 9)
    series = 1 - tau * (1 / 8) * series
    series = 1 - tau * (1 / 7) * series
    series = 1 - tau * (1 / 6) * series
    series = 1 - tau * (1 / 5) * series
    series = 1 - tau * (1 / 4) * series
    series = 1 - tau * (1 / 3) * series
    series = 1 - tau * (1 / 2) * series
    return tl.where(tau < 0.5, tau * series, 1 - tl.exp(-tau))


@triton.jit
def optical_depth(sigma, delta):
    """Return the optical depth of intervals, as in `nerfloom.kernels.compositing.density.optical_depth`.

    Args:
        sigma: densities.
        delta: lengths.
    """
    # Comparisons, not minima, keep NaN.
    density = tl.where(sigma > MAX_FLOAT, MAX_FLOAT, sigma)
    length = tl.where(delta > MAX_FLOAT, MAX_FLOAT, delta)
    tau = density * length
    return tl.where(tau > MAX_OPTICAL_DEPTH, MAX_OPTICAL_DEPTH, tau)


@triton.jit
def depth_slope(sigma, delta):
    """Return the derivative of the optical depth by the density: 0 if it is clamped, and for infinite intervals.

    Args:
        sigma: densities.
        delta: lengths.
    """
    return tl.where((sigma * delta > MAX_OPTICAL_DEPTH) | (delta > MAX_FLOAT), 0.0, delta)
