"""Structural similarity and its derivative, in Triton. `kernels.images.ssim` has the reference and the equations.

The window's Gaussian is a product of two lines. So four maps are blurred along rows, then along columns; the derivative
blurs three maps in the same way. An element of a map is a value of the image, with the channel last.
"""

# mypy: allow-untyped-defs, allow-untyped-decorators, allow-incomplete-defs
# Triton gives the kernels' arguments their types.

from __future__ import annotations

import functools

import torch
import triton
import triton.language as tl
from torch import Tensor

from nerfloom.kernels.images.ssim import C1, C2, SIGMA, WINDOW, least_in_windows, weighted_error
from nerfloom.kernels.known_gradient import KnownGradient
from nerfloom.kernels.triton_launch import blocks, launch, own_rows

BLOCK = 256
"""Elements per program."""


@functools.lru_cache(maxsize=4)
def _line(device: torch.device) -> Tensor:
    """Return the (WINDOW,) weights of the window along an axis."""
    offsets = torch.arange(WINDOW, device=device, dtype=torch.float64) - WINDOW // 2
    line = torch.exp(-(offsets**2) / (2 * SIGMA**2))
    return (line / line.sum()).float()


@triton.jit
def _rows(image, target, line, maps, count, row, shorter, channels, WINDOW: tl.constexpr, BLOCK: tl.constexpr):
    """Blur u, v, u^2 and v^2 along rows of `row` values, which leaves `shorter` values of each."""
    i, here = own_rows(count, BLOCK)
    at = i // shorter * row + i % shorter
    mean_u = tl.zeros([BLOCK], tl.float32)
    mean_v, square_u, square_v = mean_u, mean_u, mean_u
    for k in range(WINDOW):
        weight = tl.load(line + k)
        x = tl.load(image + at + k * channels, mask=here, other=0.0)
        y = tl.load(target + at + k * channels, mask=here, other=0.0)
        u, v = x + y - 1, x - y
        mean_u += weight * u
        mean_v += weight * v
        square_u += weight * u * u
        square_v += weight * v * v
    tl.store(maps + i, mean_u, mask=here)
    tl.store(maps + count + i, mean_v, mask=here)
    tl.store(maps + 2 * count + i, square_u, mask=here)
    tl.store(maps + 3 * count + i, square_v, mask=here)


@triton.jit
def _windows(
    maps, line, weights, sums, slopes, size, count, row, channels, c1, c2, WINDOW: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Blur maps of `size` elements along columns; sum 1 - S, and write the three derivatives of S if requested. Both
    are multiplied by the weights of windows, if there are any."""
    i, here = own_rows(count, BLOCK)
    mean_u = tl.zeros([BLOCK], tl.float32)
    mean_v, square_u, square_v = mean_u, mean_u, mean_u
    for k in range(WINDOW):
        weight = tl.load(line + k)
        at = maps + i + k * row
        mean_u += weight * tl.load(at, mask=here, other=0.0)
        mean_v += weight * tl.load(at + size, mask=here, other=0.0)
        square_u += weight * tl.load(at + 2 * size, mask=here, other=0.0)
        square_v += weight * tl.load(at + 3 * size, mask=here, other=0.0)
    spread_u, spread_v = square_u - mean_u * mean_u, square_v - mean_v * mean_v
    # S = (1 - a) (1 - b), where a compares the means and b the structures.
    by_mean = ((mean_u + 1) * (mean_u + 1) + mean_v * mean_v) / 2 + c1
    by_spread = (spread_u + spread_v) / 2 + c2
    a, b = mean_v * mean_v / by_mean, spread_v / by_spread
    counts = tl.full([BLOCK], 1.0, tl.float32)
    if weights is not None:
        counts = tl.load(weights + i // channels, mask=here, other=0.0)
    tl.store(sums + tl.program_id(0), tl.sum(tl.where(here, counts * (a + b - a * b), 0.0), 0))
    if slopes is not None:
        of_square_u = (1 - a) * b / (2 * by_spread)
        of_square_v = (1 - a) * (b / 2 - 1) / by_spread
        of_mean_u = (1 - b) * a * (mean_u + 1) / by_mean - 2 * mean_u * of_square_u
        of_mean_v = (1 - b) * mean_v * (a - 2) / by_mean - 2 * mean_v * of_square_v
        tl.store(slopes + i, counts * (of_mean_u + of_mean_v), mask=here)
        tl.store(slopes + count + i, counts * of_square_u, mask=here)
        tl.store(slopes + 2 * count + i, counts * of_square_v, mask=here)


@triton.jit
def _columns_back(slopes, line, maps, size, count, row, windows, WINDOW: tl.constexpr, BLOCK: tl.constexpr):
    """Sum three maps of `size` elements, in `windows` rows, over the windows that cover each row of the image."""
    i, here = own_rows(count, BLOCK)
    y = i // row
    one = tl.zeros([BLOCK], tl.float32)
    two, three = one, one
    for k in range(WINDOW):
        weight = tl.load(line + k)
        reached = here & (y >= k) & (y - k < windows)
        at = slopes + i - k * row
        one += weight * tl.load(at, mask=reached, other=0.0)
        two += weight * tl.load(at + size, mask=reached, other=0.0)
        three += weight * tl.load(at + 2 * size, mask=reached, other=0.0)
    tl.store(maps + i, one, mask=here)
    tl.store(maps + count + i, two, mask=here)
    tl.store(maps + 2 * count + i, three, mask=here)


@triton.jit
def _rows_back(
    maps, line, image, target, derivative, size, count, row, shorter, channels, scale, WINDOW: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """Sum the maps over the windows that cover each value of the image, and write the derivative."""
    i, here = own_rows(count, BLOCK)
    y, x = i // row, i % row
    one = tl.zeros([BLOCK], tl.float32)
    two, three = one, one
    for k in range(WINDOW):
        weight = tl.load(line + k)
        reached = here & (x >= k * channels) & (x - k * channels < shorter)
        at = maps + y * shorter + x - k * channels
        one += weight * tl.load(at, mask=reached, other=0.0)
        two += weight * tl.load(at + size, mask=reached, other=0.0)
        three += weight * tl.load(at + 2 * size, mask=reached, other=0.0)
    a = tl.load(image + i, mask=here, other=0.0)
    b = tl.load(target + i, mask=here, other=0.0)
    tl.store(derivative + i, scale * (one + 2 * (a + b - 1) * two + 2 * (a - b) * three), mask=here)


def _ssim(image: Tensor, target: Tensor, weights: Tensor | None) -> Tensor:
    """Return the mean SSIM of contiguous images, and its derivative by the first if that is followed."""
    height, width, channels = image.shape
    line, constants = _line(image.device), {"WINDOW": WINDOW, "BLOCK": BLOCK}
    row, shorter, windows = width * channels, (width - WINDOW + 1) * channels, height - WINDOW + 1
    size, count = height * shorter, windows * shorter
    maps, sums = image.new_empty(4, size), image.new_empty(blocks(count, BLOCK))
    slopes = image.new_empty(3, count) if image.requires_grad and torch.is_grad_enabled() else None
    launch(_rows, (blocks(size, BLOCK),), image, target, line, maps, size, row, shorter, channels, **constants)
    least = None if weights is None else least_in_windows(weights).contiguous()
    launch(
        _windows, (blocks(count, BLOCK),), maps, line, least, sums, slopes, size, count, shorter, channels, C1, C2,
        **constants,
    )  # fmt: skip
    value = (1 - sums.double().sum() / count).to(image.dtype)
    if slopes is None:
        return value
    derivative = torch.empty_like(image)
    launch(_columns_back, (blocks(size, BLOCK),), slopes, line, maps, count, size, shorter, windows, **constants)
    launch(
        _rows_back, (blocks(image.numel(), BLOCK),), maps, line, image, target, derivative, size, image.numel(), row,
        shorter, channels, 1 / count, **constants,
    )  # fmt: skip
    return KnownGradient.apply((value, derivative), image)


def photometric_loss(image: Tensor, target: Tensor, ssim_weight: float, weights: Tensor | None = None) -> Tensor:
    """Compute `ssim.photometric_loss` of `image`, `target`, `ssim_weight` and `weights`, with its first derivative."""
    similarity = _ssim(image.contiguous(), target.contiguous(), weights)
    return (1 - ssim_weight) * weighted_error(image, target, weights) + ssim_weight * (1 - similarity)
