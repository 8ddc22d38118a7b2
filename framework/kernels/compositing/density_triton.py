"""Compositing and distortion of packed samples, in Triton. `nerfloom.kernels.compositing.density` has the equations.

A program processes a ray, in blocks of samples. Sums in front of a sample are computed without the sample, from its
neighbours' values, because subtracting a large value from its own sum would leave rounding errors.
"""

# Triton gives the kernels' arguments their types.
# mypy: allow-untyped-defs, allow-untyped-decorators, allow-incomplete-defs

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from nerfloom.geometry.rays import Samples
from nerfloom.kernels.compositing.density import Composited, _Distortion
from nerfloom.kernels.triton_launch import depth_slope, launch, opacity_of, optical_depth, store_three

BLOCK = 32
"""Samples of a ray processed together, by one warp."""


@triton.jit
def _forward(
    sigma, rgb, starts, ends, points, offsets, background, fars, color, opacity, moment, median, weights, through,
    BLOCK: tl.constexpr,
):  # fmt: skip
    ray = tl.program_id(0).to(tl.int64)
    begin = tl.load(offsets + ray)
    end = tl.load(offsets + ray + 1)
    far = tl.load(fars + ray)
    depth, total, mean, half = 0.0, 0.0, 0.0, far
    red, green, blue = 0.0, 0.0, 0.0
    for first in range(begin, end, BLOCK):
        n = first + tl.arange(0, BLOCK)
        here = n < end
        start = tl.load(starts + n, mask=here, other=0.0)
        stop = tl.load(ends + n, mask=here, other=0.0)
        tau = optical_depth(tl.load(sigma + n, mask=here, other=0.0), stop - start)
        before = here & (n > begin)  # for the neighbour in front
        length = tl.load(ends + n - 1, mask=before, other=0.0) - tl.load(starts + n - 1, mask=before, other=0.0)
        passed = optical_depth(tl.load(sigma + n - 1, mask=before, other=0.0), length)
        in_front = tl.exp(-(depth + tl.cumsum(passed, 0)))
        depth += tl.sum(passed, 0)
        weight = in_front * opacity_of(tau)
        tl.store(weights + n, weight, mask=here)
        if through is not None:
            tl.store(through + n, in_front, mask=here)
        t = (start + stop) / 2
        if points is not None:
            t = tl.load(points + n, mask=here, other=0.0)
        weight = tl.where(here, weight, 0.0)
        total += tl.sum(weight, 0)
        mean += tl.sum(tl.where(weight == 0, 0.0, weight * t), 0)  # t is infinite in the middle of an infinite interval
        red += tl.sum(weight * tl.load(rgb + n * 3, mask=here, other=0.0), 0)
        green += tl.sum(weight * tl.load(rgb + n * 3 + 1, mask=here, other=0.0), 0)
        blue += tl.sum(weight * tl.load(rgb + n * 3 + 2, mask=here, other=0.0), 0)
        crossed = here & (in_front - weight <= 0.5) & (t < far)
        half = tl.minimum(half, tl.min(tl.where(crossed, t, far), 0))
    left = tl.where(1 - total < 0, 0.0, 1 - total)
    tl.store(color + ray * 3, red + left * tl.load(background + ray * 3))
    tl.store(color + ray * 3 + 1, green + left * tl.load(background + ray * 3 + 1))
    tl.store(color + ray * 3 + 2, blue + left * tl.load(background + ray * 3 + 2))
    tl.store(opacity + ray, total)
    tl.store(moment + ray, mean)
    tl.store(median + ray, half)


@triton.jit
def _backward(
    sigma, rgb, starts, ends, offsets, background, opacity, through, of_color, of_opacity, of_weights, of_sigma, of_rgb,
    BLOCK: tl.constexpr,
):  # fmt: skip
    # With g_i = dL/dw_i:  dL/dtau_i = g_i T_{i+1} - sum_{j > i} g_j w_j, from the last block of the ray to the first.
    ray = tl.program_id(0).to(tl.int64)
    begin = tl.load(offsets + ray)
    end = tl.load(offsets + ray + 1)
    red = tl.load(of_color + ray * 3)
    green = tl.load(of_color + ray * 3 + 1)
    blue = tl.load(of_color + ray * 3 + 2)
    behind = red * tl.load(background + ray * 3) + green * tl.load(background + ray * 3 + 1)
    behind += blue * tl.load(background + ray * 3 + 2)
    base = tl.where(1 - tl.load(opacity + ray) >= 0, -behind, 0.0)
    if of_opacity is not None:
        base += tl.load(of_opacity + ray)
    after = 0.0
    for back in range(0, end - begin, BLOCK):
        n = end - back - BLOCK + tl.arange(0, BLOCK)
        here = n >= begin
        density = tl.load(sigma + n, mask=here, other=0.0)
        delta = tl.load(ends + n, mask=here, other=0.0) - tl.load(starts + n, mask=here, other=0.0)
        tau = optical_depth(density, delta)
        in_front = tl.load(through + n, mask=here, other=0.0)
        weight = in_front * opacity_of(tau)
        own = base + red * tl.load(rgb + n * 3, mask=here, other=0.0)
        own += green * tl.load(rgb + n * 3 + 1, mask=here, other=0.0)
        own += blue * tl.load(rgb + n * 3 + 2, mask=here, other=0.0)
        if of_weights is not None:
            own += tl.load(of_weights + n, mask=here, other=0.0)
        share = tl.where(here, own * weight, 0.0)
        later = after + tl.cumsum(share, 0, reverse=True) - share
        after += tl.sum(share, 0)
        slope = depth_slope(density, delta)
        gradient = tl.where(slope == 0, 0.0, slope * (own * in_front * tl.exp(-tau) - later))
        tl.store(of_sigma + n, gradient, mask=here)
        store_three(of_rgb + n * 3, weight * red, weight * green, weight * blue, here)


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, sigma: Tensor, rgb: Tensor, starts: Tensor, ends: Tensor, points: Tensor | None, offsets: Tensor,
        background: Tensor, fars: Tensor,
    ) -> tuple[Tensor, ...]:  # fmt: skip
        rays = len(offsets) - 1
        color, opacity, moment, median = fars.new_empty(rays, 3), *(torch.empty_like(fars) for _ in range(3))
        weights = torch.empty_like(sigma)
        through = torch.empty_like(sigma) if any(ctx.needs_input_grad) else None
        launch(
            _forward, (rays,), sigma, rgb, starts, ends, points, offsets, background, fars, color, opacity, moment,
            median, weights, through, BLOCK=BLOCK, num_warps=1,
        )  # fmt: skip
        if through is not None:
            ctx.save_for_backward(sigma, rgb, starts, ends, offsets, background, opacity, through)
        ctx.mark_non_differentiable(moment, median)
        ctx.set_materialize_grads(False)
        return color, opacity, moment, median, weights

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        sigma, rgb, starts, ends, offsets, background, opacity, through = ctx.saved_tensors
        of_color = torch.zeros_like(background) if grads[0] is None else grads[0].contiguous()
        of_opacity, of_weights = (None if grad is None else grad.contiguous() for grad in (grads[1], grads[4]))
        of_sigma, of_rgb = torch.empty_like(sigma), torch.empty_like(rgb)
        launch(
            _backward, (len(offsets) - 1,), sigma, rgb, starts, ends, offsets, background, opacity, through, of_color,
            of_opacity, of_weights, of_sigma, of_rgb, BLOCK=BLOCK, num_warps=1,
        )  # fmt: skip
        return of_sigma, of_rgb, None, None, None, None, None, None


def composite(samples: Samples, sigma: Tensor, rgb: Tensor, background: Tensor, fars: Tensor) -> Composited:
    """Compute `density.composite` of `samples`, `sigma`, `rgb`, `background` and `fars`, with its gradients."""
    points = None if samples.points is None else samples.points.contiguous()
    inputs = (tensor.contiguous() for tensor in (sigma, rgb, samples.t_starts, samples.t_ends))
    offsets, background, fars = samples.offsets.contiguous(), background.contiguous(), fars.contiguous()
    return Composited(*_Composite.apply(*inputs, points, offsets, background, fars))


@triton.jit
def _distortion(weights, starts, ends, offsets, loss, of_weights, BLOCK: tl.constexpr):
    # The distance of two middles is the sum of the gaps between them. Seen from behind, a gap counts with all weight in
    # front of it; from in front, with all weight behind it. No term is negative, so nothing cancels.
    ray = tl.program_id(0).to(tl.int64)
    begin = tl.load(offsets + ray)
    end = tl.load(offsets + ray + 1)
    total, apart, spread = 0.0, 0.0, 0.0
    for first in range(begin, end, BLOCK):
        n = first + tl.arange(0, BLOCK)
        here = n < end
        before = here & (n > begin)
        weight = tl.load(weights + n, mask=here, other=0.0)
        start = tl.load(starts + n, mask=here, other=0.0)
        stop = tl.load(ends + n, mask=here, other=0.0)
        gap = (start - tl.load(starts + n - 1, mask=before, other=0.0)) / 2
        gap += (stop - tl.load(ends + n - 1, mask=before, other=0.0)) / 2
        passed = tl.load(weights + n - 1, mask=before, other=0.0)
        steps = tl.where(before, gap * (total + tl.cumsum(passed, 0)), 0.0)
        total += tl.sum(passed, 0)
        front = apart + tl.cumsum(steps, 0)
        apart += tl.sum(steps, 0)
        own = weight * (stop - start) / 3
        spread += tl.sum(weight * (2 * front + own), 0)
        tl.store(of_weights + n, 2 * (front + own), mask=here)
    tl.store(loss + ray, spread)
    tl.debug_barrier()  # other threads may read these values below
    total, apart = 0.0, 0.0
    for back in range(0, end - begin, BLOCK):
        n = end - back - BLOCK + tl.arange(0, BLOCK)
        here = n >= begin
        before = here & (n < end - 1)  # for the neighbour behind
        gap = (tl.load(starts + n + 1, mask=before, other=0.0) - tl.load(starts + n, mask=before, other=0.0)) / 2
        gap += (tl.load(ends + n + 1, mask=before, other=0.0) - tl.load(ends + n, mask=before, other=0.0)) / 2
        passed = tl.load(weights + n + 1, mask=before, other=0.0)
        steps = tl.where(before, gap * (total + tl.cumsum(passed, 0, reverse=True)), 0.0)
        total += tl.sum(passed, 0)
        behind = apart + tl.cumsum(steps, 0, reverse=True)
        apart += tl.sum(steps, 0)
        tl.store(of_weights + n, tl.load(of_weights + n, mask=here, other=0.0) + 2 * behind, mask=here)


def distortion(weights: Tensor, samples: Samples) -> Tensor:
    """Compute `density.distortion` of `weights` and `samples`, with the gradient of the weights."""
    inputs = [tensor.contiguous() for tensor in (weights, samples.t_starts, samples.t_ends, samples.offsets)]
    weights, _, _, offsets = inputs
    loss, of_weights = weights.new_empty(samples.num_rays), torch.empty_like(weights)
    launch(_distortion, (samples.num_rays,), *inputs, loss, of_weights, BLOCK=BLOCK, num_warps=1)
    return _Distortion.apply((loss, of_weights), offsets, weights)
