"""Compositing: from densities to the weight of each sample.

Max 1995, and NeRF (Mildenhall et al. 2020) equation 3, for intervals of constant density:

    tau_i = sigma_i * delta_i                   optical depth of an interval
    T_i   = exp(-sum_{j < i} tau_j)             transmittance in front of it
    w_i   = T_i * (1 - exp(-tau_i))             weight

Optical depth is summed and exponentiated, and alpha is -expm1(-tau): products of (1 - alpha) lose every
optical depth below 6e-8, so that a thousand thin samples would vanish.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from framework.geometry.rays import Samples
from framework.kernels import native
from framework.kernels.dispatch import CPP, Operation
from framework.kernels.given import check_offsets

MAX_OPTICAL_DEPTH = 1e3
"""Of one interval. exp(-1000) is 0 even in float64, so nothing is lost, and sums stay finite."""


def optical_depth(sigma: Tensor, deltas: Tensor) -> Tensor:
    """tau (N,) = sigma * delta, in [0, MAX_OPTICAL_DEPTH]; none where density or length is 0, whatever the other.

    NaN densities stay NaN: a broken field must be seen. The density of an interval without end learns nothing: there
    tau leaps from 0 to its bound as soon as there is any.
    """
    # Infinity times 0 would be NaN, in tau and in its gradient, so the largest number stands for it.
    lengths = deltas.clamp(max=torch.finfo(deltas.dtype).max)
    sigma = torch.where(deltas == torch.inf, sigma.detach(), sigma).clamp(max=torch.finfo(sigma.dtype).max)
    return (sigma * lengths).clamp(max=MAX_OPTICAL_DEPTH)


def exclusive_cumsum(values: Tensor) -> Tensor:
    """(..., S) sum of `values` (..., S) over those in front in the last dimension.

    Sums are moved on by one. Taking each value out of its own sum again would leave, of a large one, its rounding.
    """
    return functional.pad(values, (1, 0)).cumsum(-1)[..., :-1]


def segmented_sum(values: Tensor, places: Tensor) -> Tensor:
    """(N,) sum of `values` (N,) over the `places` (N,) samples right in front of each, which are those of its ray.

    Values of two rays never meet, so NaN and rounding stay where they are. In log2 S passes, each of which doubles
    how many are added up (Hillis and Steele 1986); unlike rows of S for each ray, one long ray costs no memory.
    """
    most = int(places.max()) if len(places) else 0
    total, reach = values.roll(1).masked_fill(places < 1, 0), 1
    while reach < most:
        total = total + total.roll(reach).masked_fill(places < reach, 0)
        reach *= 2
    return total


def exclusive_sum(values: Tensor, samples: Samples) -> Tensor:
    """(N,) sum of `values` (N,) over the samples in front on the same ray."""
    if samples.per_ray is not None:
        return exclusive_cumsum(samples.padded(values)).reshape(-1)
    return segmented_sum(values, samples.ranks)


def ray_sum(values: Tensor, samples: Samples) -> Tensor:
    """(R, ...) sum of `values` (N, ...) over each ray's samples; 0 for a ray without samples."""
    if samples.per_ray is not None:
        return samples.padded(values).sum(1)
    total = values.new_zeros(samples.num_rays, *values.shape[1:])
    return total.index_add(0, samples.ray_indices, values)


def weights_and_transmittance(sigma: Tensor, samples: Samples) -> tuple[Tensor, Tensor]:
    """Weights (N,) and the transmittance (N,) in front of each sample.

    Args:
        sigma: (N,) density, 1/length, at least 0.
        samples: the intervals.
    """
    tau = optical_depth(sigma, samples.deltas)
    transmittance = torch.exp(-exclusive_sum(tau, samples))
    return transmittance * -torch.expm1(-tau), transmittance


class Composited(NamedTuple):
    """What light along R rays adds up to."""

    color: Tensor
    """(R, 3) over the background."""
    opacity: Tensor
    """(R,) the sum of the weights."""
    moment: Tensor
    """(R,) the sum of weight * t; without gradient."""
    median: Tensor
    """(R,) the t behind which at most half of the light is left, or the ray's far end; without gradient."""
    weights: Tensor
    """(N,)"""


def composite_reference(samples: Samples, sigma: Tensor, rgb: Tensor, background: Tensor, fars: Tensor) -> Composited:
    """The sums in torch: the truth, in any float type. Arguments as for `composite`."""
    weights, transmittance = weights_and_transmittance(sigma, samples)
    opacity = ray_sum(weights, samples)
    left = (1 - opacity).clamp(min=0)
    color = ray_sum(weights[:, None] * rgb, samples) + left[:, None] * background
    with torch.no_grad():
        # An endless interval has an infinite t: where it stops no light, it has no part in the mean.
        moment = ray_sum((weights * samples.t).masked_fill(weights == 0, 0), samples)
        far = fars[samples.ray_indices]
        seen = torch.where(transmittance - weights <= 0.5, torch.minimum(samples.t, far), far)
        median = fars.to(seen.dtype).scatter_reduce(0, samples.ray_indices, seen, "amin")
    return Composited(color, opacity, moment, median, weights)


_forward = native.Function("composite_forward", "ppppppqqpppppppi")
_backward = native.Function("composite_backward", "pppppqqppppppppi")


class _Composite(torch.autograd.Function):
    """The compiled sums: one pass over a ray forward, two backward."""

    @staticmethod
    def forward(
        ctx: Any, sigma: Tensor, rgb: Tensor, starts: Tensor, ends: Tensor, points: Tensor | None, offsets: Tensor,
        background: Tensor, fars: Tensor,
    ) -> tuple[Tensor, ...]:  # fmt: skip
        count, rays = len(sigma), len(offsets) - 1
        color, opacity, moment, median = fars.new_empty(rays, 3), *(torch.empty_like(fars) for _ in range(3))
        weights = torch.empty_like(sigma)
        _forward(
            native.pointer(sigma, "sigma", (count,)), native.pointer(rgb, "rgb", (count, 3)),
            native.pointer(starts, "t_starts", (count,)), native.pointer(ends, "t_ends", (count,)),
            None if points is None else native.pointer(points, "points", (count,)),
            native.pointer(offsets, "offsets", (rays + 1,), torch.int64), rays, count,
            native.pointer(background, "the background", (rays, 3)), native.pointer(fars, "fars", (rays,)),
            color.data_ptr(), opacity.data_ptr(), moment.data_ptr(), median.data_ptr(), weights.data_ptr(),
            native.threads(),
        )  # fmt: skip
        ctx.save_for_backward(sigma, rgb, starts, ends, offsets, background, weights, opacity)
        ctx.mark_non_differentiable(moment, median)
        ctx.set_materialize_grads(False)
        return color, opacity, moment, median, weights

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        sigma, rgb, starts, ends, offsets, background, weights, opacity = ctx.saved_tensors
        count, rays = len(sigma), len(offsets) - 1
        of_color = torch.zeros_like(background) if grads[0] is None else grads[0].contiguous()
        of_opacity, of_weights = (None if g is None else g.contiguous() for g in (grads[1], grads[4]))
        of_sigma, of_rgb = torch.empty_like(sigma), torch.empty_like(rgb)
        _backward(
            sigma.data_ptr(), rgb.data_ptr(), starts.data_ptr(), ends.data_ptr(), offsets.data_ptr(), rays, count,
            background.data_ptr(), weights.data_ptr(), opacity.data_ptr(),
            native.pointer(of_color, "the colour's gradient", (rays, 3)),
            None if of_opacity is None else native.pointer(of_opacity, "the opacity's gradient", (rays,)),
            None if of_weights is None else native.pointer(of_weights, "the weights' gradient", (count,)),
            of_sigma.data_ptr(), of_rgb.data_ptr(), native.threads(),
        )  # fmt: skip
        return of_sigma, of_rgb, None, None, None, None, None, None


def composite(samples: Samples, sigma: Tensor, rgb: Tensor, background: Tensor, fars: Tensor) -> Composited:
    """Colour, opacity and depth of R rays from N packed samples.

    Args:
        samples: the intervals.
        sigma: (N,) density.
        rgb: (N, 3) colour.
        background: (R, 3) or (3,) what shows where a ray is not opaque.
        fars: (R,) the rays' far ends.
    Raises: IndexError where the samples' offsets do not divide them between the rays.
    """
    check_offsets(samples.offsets, len(samples))
    background = background.expand(samples.num_rays, 3)
    tensors = (sigma, rgb, samples.t_starts, samples.t_ends, samples.points, background, fars)
    return COMPOSITE(tensors, samples, sigma, rgb, background, fars)


COMPOSITE = Operation("composite", composite_reference)


@COMPOSITE.implementation(CPP, differentiable=2)
def _composite(samples: Samples, sigma: Tensor, rgb: Tensor, background: Tensor, fars: Tensor) -> Composited:
    points = None if samples.points is None else samples.points.contiguous()
    inputs = (tensor.contiguous() for tensor in (sigma, rgb, samples.t_starts, samples.t_ends))
    return Composited(*_Composite.apply(*inputs, points, samples.offsets, background.contiguous(), fars.contiguous()))


def distortion_by_pairs(weights: Tensor, samples: Samples) -> Tensor:
    """As `distortion`, over all pairs of samples of a ray: O(N^2), the truth."""
    middles, losses = (samples.t_starts + samples.t_ends) / 2, []
    for start, end in zip(samples.offsets[:-1].tolist(), samples.offsets[1:].tolist(), strict=True):
        w, m, delta = weights[start:end], middles[start:end], samples.deltas[start:end]
        pairs = (w[:, None] * w * (m[:, None] - m).abs()).sum()
        losses.append(pairs + (w * w * delta).sum() / 3)
    return torch.stack(losses) if losses else weights.sum()[None][:0]


def distortion_reference(weights: Tensor, samples: Samples) -> Tensor:
    """As `distortion`, in torch, on any device and in any float type."""
    # m_i - m_j is the sum of the gaps between neighbouring middles from j to i: each counts for all weight in front.
    # No term is negative, so nothing cancels, wherever the weights lie and however close together.
    starts, ends = samples.t_starts, samples.t_ends
    gaps = ((starts - starts.roll(1)) + (ends - ends.roll(1))).masked_fill(samples.ranks == 0, 0) / 2
    steps = gaps * exclusive_sum(weights, samples)
    apart = exclusive_sum(steps, samples) + steps
    return ray_sum(weights * (2 * apart + weights * samples.deltas / 3), samples)


_distortion = native.Function("distortion", "ppppqqppi")


class _Distortion(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, weights: Tensor, starts: Tensor, ends: Tensor, offsets: Tensor) -> Tensor:
        count, rays = len(weights), len(offsets) - 1
        loss, of_weights = weights.new_empty(rays), torch.empty_like(weights)
        _distortion(
            native.pointer(weights, "weights", (count,)), native.pointer(starts, "t_starts", (count,)),
            native.pointer(ends, "t_ends", (count,)), native.pointer(offsets, "offsets", (rays + 1,), torch.int64),
            rays, count, loss.data_ptr(), of_weights.data_ptr(), native.threads(),
        )  # fmt: skip
        ctx.save_for_backward(of_weights, offsets)
        return loss

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None, None]:
        of_weights, offsets = ctx.saved_tensors
        return of_weights * grad.repeat_interleave(offsets[1:] - offsets[:-1]), None, None, None


def distortion(weights: Tensor, samples: Samples) -> Tensor:
    """How far a ray's light is spread along it (mip-NeRF 360, Barron et al. 2022, equation 15), not by pairs.

    Args:
        weights: (N,).
        samples: their intervals.
    Returns: (R,) sum_ij w_i w_j |m_i - m_j| + sum_i w_i^2 delta_i / 3, in the unit of t.
    Raises: IndexError where the samples' offsets do not divide them between the rays.
    """
    check_offsets(samples.offsets, len(samples))
    return DISTORTION((weights, samples.t_starts, samples.t_ends), weights, samples)


DISTORTION = Operation("distortion", distortion_reference)


@DISTORTION.implementation(CPP, differentiable=1)
def _distortion_compiled(weights: Tensor, samples: Samples) -> Tensor:
    inputs = (tensor.contiguous() for tensor in (weights, samples.t_starts, samples.t_ends))
    return _Distortion.apply(*inputs, samples.offsets)
