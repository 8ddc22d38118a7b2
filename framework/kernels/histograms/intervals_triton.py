"""Histograms along rays, in Triton. `nerfloom.kernels.histograms.intervals` has the references.

A program processes a ray, in blocks of bins. Sums of weights that are subtracted are float64, as are their differences;
the bin of a value is found by bisection of the sums.
"""

# mypy: allow-untyped-defs, allow-untyped-decorators, allow-incomplete-defs
# Triton gives the kernels' arguments their types.

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from nerfloom.kernels.histograms.intervals import EPS
from nerfloom.kernels.known_gradient import KnownGradient
from nerfloom.kernels.triton_launch import depth_slope, launch, on_device, opacity_of, optical_depth

BLOCK = 64
"""Bins of a ray processed together, by one warp."""


@triton.jit
def _weights(sigma, t, weights, bins, BLOCK: tl.constexpr):
    ray = tl.program_id(0).to(tl.int64)
    sigma += ray * bins
    t += ray * (bins + 1)
    weights += ray * bins
    depth = 0.0
    for first in range(0, bins, BLOCK):
        i = first + tl.arange(0, BLOCK)
        here = i < bins
        before = here & (i > 0)  # for the neighbour in front
        edge = tl.load(t + i, mask=here, other=0.0)
        tau = optical_depth(tl.load(sigma + i, mask=here, other=0.0), tl.load(t + i + 1, mask=here, other=0.0) - edge)
        length = tl.where(before, edge - tl.load(t + i - 1, mask=before, other=0.0), 0.0)
        passed = optical_depth(tl.load(sigma + i - 1, mask=before, other=0.0), length)
        tl.store(weights + i, tl.exp(-(depth + tl.cumsum(passed, 0))) * opacity_of(tau), mask=here)
        depth += tl.sum(passed, 0)


@triton.jit
def _weights_backward(sigma, t, weights, grad, of_sigma, bins, BLOCK: tl.constexpr):
    # With g_i = dL/dw_i:  dL/dtau_i = g_i T_{i+1} - sum_{j > i} g_j w_j.
    ray = tl.program_id(0).to(tl.int64)
    sigma += ray * bins
    t += ray * (bins + 1)
    weights += ray * bins
    grad += ray * bins
    of_sigma += ray * bins
    after = 0.0
    for first in range(0, bins, BLOCK):
        i = first + tl.arange(0, BLOCK)
        here = i < bins
        after += tl.sum(tl.load(grad + i, mask=here, other=0.0) * tl.load(weights + i, mask=here, other=0.0), 0)
    depth = 0.0
    for first in range(0, bins, BLOCK):
        i = first + tl.arange(0, BLOCK)
        here = i < bins
        density = tl.load(sigma + i, mask=here, other=0.0)
        delta = tl.load(t + i + 1, mask=here, other=0.0) - tl.load(t + i, mask=here, other=0.0)
        tau = optical_depth(density, delta)
        own = tl.load(grad + i, mask=here, other=0.0)
        share = own * tl.load(weights + i, mask=here, other=0.0)
        behind = after - tl.cumsum(share, 0)
        left = tl.exp(-(depth + tl.cumsum(tau, 0)))
        slope = depth_slope(density, delta)
        tl.store(of_sigma + i, tl.where(slope == 0, 0.0, slope * (own * left - behind)), mask=here)
        after -= tl.sum(share, 0)
        depth += tl.sum(tau, 0)


class _Weights(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, sigma: Tensor, t: Tensor) -> Tensor:
        (rays, bins), weights = sigma.shape, torch.empty_like(sigma)
        launch(_weights, (rays,), sigma, t, weights, bins, BLOCK=BLOCK, num_warps=1)
        ctx.save_for_backward(sigma, t, weights)
        return weights

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        sigma, t, weights = ctx.saved_tensors
        (rays, bins), of_sigma = sigma.shape, torch.empty_like(sigma)
        launch(
            _weights_backward, (rays,), sigma, t, weights, grad.contiguous(), of_sigma, bins, BLOCK=BLOCK, num_warps=1
        )
        return of_sigma, None


def interval_weights(sigma: Tensor, t: Tensor) -> Tensor:
    """Compute `kernels.histograms.intervals.interval_weights` of `sigma` and `t`, with the density's gradient."""
    return _Weights.apply(sigma.contiguous(), t.contiguous())


@triton.jit
def _sums(values, sums, count, power, padding, BLOCK: tl.constexpr):
    """Write the sums of values^power + padding up to each value, in float64; return the total."""
    total = tl.full([], 0.0, tl.float64)
    for first in range(0, count, BLOCK):
        i = first + tl.arange(0, BLOCK)
        here = i < count
        value = tl.load(values + i, mask=here, other=0.0)
        raised = tl.exp2(power * tl.log2(value))
        raised = tl.where(power == 1, value, tl.where(power == 0, 1.0, tl.where(value == 0, 0.0, raised)))
        heavy = tl.where(here, raised.to(tl.float64) + padding, 0.0)
        tl.store(sums + i, total + tl.cumsum(heavy, 0), mask=here)
        total += tl.sum(heavy, 0)
    tl.debug_barrier()  # any thread may read these values
    return total


@triton.jit
def _preceding(values, bound, most, steps, AT: tl.constexpr):
    """Return the number of the first `most` sorted values that are below a bound or, with AT, not above it."""
    low = tl.zeros_like(bound).to(tl.int32)
    high = low + most
    for _ in range(steps):
        middle = (low + high) // 2
        undecided = low < high
        value = tl.load(values + middle, mask=undecided, other=0.0)
        precedes = value < bound
        if AT:
            precedes = value <= bound
        low = tl.where(undecided & precedes, middle + 1, low)
        high = tl.where(precedes, high, middle)
    return low


@triton.jit
def _resample(edges, weights, shift, power, sums, out, bins, count, padding, steps, BLOCK: tl.constexpr):
    ray = tl.program_id(0).to(tl.int64)
    edges += ray * (bins + 1)
    sums += ray * bins
    out += ray * (count + 1)
    total = _sums(weights + ray * bins, sums, bins, tl.load(power), padding, BLOCK)
    offset = tl.load(shift + ray).to(tl.float64)
    for first in range(0, count + 1, BLOCK):
        j = first + tl.arange(0, BLOCK)
        u = total * (j.to(tl.float64) + offset) / (count + 1)
        place = _preceding(sums, u, bins - 1, steps, True)
        low = tl.load(sums + place - 1, mask=place > 0, other=0.0)
        width = tl.load(sums + place) - low
        # Comparisons let NaN through, so that it appears in the edges.
        share = (u - low) / tl.where(width <= 0, 1.0, width)
        share = tl.where(width <= 0, 0.0, tl.where(share < 0, 0.0, tl.where(share > 1, 1.0, share)))
        start, end = tl.load(edges + place).to(tl.float64), tl.load(edges + place + 1).to(tl.float64)
        tl.store(out + j, (start + share * (end - start)).to(tl.float32), mask=j <= count)


def resample(
    edges: Tensor, weights: Tensor, shift: Tensor, count: int, power: float | Tensor, padding: float
) -> Tensor:
    """Compute `intervals.resample` of `edges`, `weights`, `shift`, `count`, `power` and `padding`."""
    rays, bins = weights.shape
    out, sums = edges.new_empty(rays, count + 1), edges.new_empty(rays, bins, dtype=torch.float64)
    launch(
        _resample, (rays,), edges.contiguous(), weights.contiguous(), shift.contiguous(), on_device(power, edges), sums,
        out, bins, count, float(padding), bins.bit_length(), BLOCK=BLOCK, num_warps=1,
    )  # fmt: skip
    return out


@triton.jit
def _touched(sums, edges, count, intervals, i, here, steps):
    """Return the weight of the bins that each interval touches, from the sums of the weights of `count` bins."""
    start = tl.load(intervals + i, mask=here, other=0.0)
    end = tl.load(intervals + i + 1, mask=here, other=0.0)
    left = _preceding(edges + 1, start, count, steps, False)
    right = tl.maximum(_preceding(edges, end, count, steps, True), left)
    weight = tl.load(sums + right - 1, mask=right > 0, other=0.0)
    return weight - tl.load(sums + left - 1, mask=left > 0, other=0.0)


@triton.jit
def _excess(
    edges, weights, proposed, proposed_weights, sums, scaled_sums, loss, of_weights, bins, proposed_bins, steps, eps,
    BLOCK: tl.constexpr,
):  # fmt: skip
    # A proposed bin touches consecutive intervals, and is touched by consecutive ones, so all sums are differences.
    ray = tl.program_id(0).to(tl.int64)
    edges += ray * (bins + 1)
    weights += ray * bins
    proposed += ray * (proposed_bins + 1)
    sums += ray * proposed_bins
    scaled_sums += ray * bins
    of_weights += ray * proposed_bins
    _sums(proposed_weights + ray * proposed_bins, sums, proposed_bins, 1.0, 0.0, BLOCK)
    spread, running = tl.full([], 0.0, tl.float64), tl.full([], 0.0, tl.float64)
    for first in range(0, bins, BLOCK):
        i = first + tl.arange(0, BLOCK)
        here = i < bins
        weight = tl.load(weights + i, mask=here, other=0.0).to(tl.float64)
        excess = weight - _touched(sums, proposed, proposed_bins, edges, i, here, steps)
        excess = tl.where(here & (excess > 0), excess, 0.0)
        scaled = excess / (weight + eps)
        spread += tl.sum(excess * scaled, 0)
        tl.store(scaled_sums + i, running + tl.cumsum(scaled, 0), mask=here)
        running += tl.sum(scaled, 0)
    tl.store(loss + ray, spread.to(tl.float32))
    tl.debug_barrier()  # any thread may read these values
    for first in range(0, proposed_bins, BLOCK):
        j = first + tl.arange(0, BLOCK)
        here = j < proposed_bins
        change = _touched(scaled_sums, edges, bins, proposed, j, here, steps)
        tl.store(of_weights + j, (-2 * change).to(tl.float32), mask=here)


def proposal_excess(edges: Tensor, weights: Tensor, proposed: Tensor, proposed_weights: Tensor) -> Tensor:
    """Compute `intervals.proposal_excess` of `edges`, `weights`, `proposed` and `proposed_weights`, with a gradient."""
    inputs = (tensor.contiguous() for tensor in (edges, weights, proposed, proposed_weights))
    edges, weights, proposed, proposed_weights = inputs
    (rays, bins), proposed_bins = weights.shape, proposed_weights.shape[1]
    loss, of_weights = weights.new_empty(rays), torch.empty_like(proposed_weights)
    sums, scaled = (weights.new_empty(rays, size, dtype=torch.float64) for size in (proposed_bins, bins))
    steps = max(bins, proposed_bins).bit_length()
    launch(
        _excess, (rays,), edges, weights, proposed, proposed_weights, sums, scaled, loss, of_weights, bins,
        proposed_bins, steps, EPS, BLOCK=BLOCK, num_warps=1,
    )  # fmt: skip
    return KnownGradient.apply((loss, of_weights), proposed_weights)
