"""Compositing: weights of samples from densities, and sums over rays.

Max 1995, and NeRF (Mildenhall et al. 2020) equation 3, for intervals of constant density:

    tau_i = sigma_i * delta_i                   optical depth of an interval
    T_i   = exp(-sum_{j < i} tau_j)             transmittance in front of it
    w_i   = T_i * (1 - exp(-tau_i))             weight

Optical depths are summed and exponentiated, and alpha is computed as -expm1(-tau). Products of (1 - alpha) would lose
optical depths below 6e-8, so that many thin samples would have no effect.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from nerfloom.geometry.rays import Samples
from nerfloom.kernels import native
from nerfloom.kernels.argument_checks import check_offsets
from nerfloom.kernels.dispatch import CPP, TRITON, Operation
from nerfloom.kernels.triton_backend import later

MAX_PADDED = 2**26
"""Maximum number of values for padding rays to the longest one, so that one pass sums them all."""
MAX_OPTICAL_DEPTH = 1e3
"""Maximum optical depth of an interval, so that sums stay finite. exp(-1000) is 0 even in float64."""


def optical_depth(sigma: Tensor, deltas: Tensor) -> Tensor:
    """Return the optical depth (N,) of intervals: sigma * delta, at most `MAX_OPTICAL_DEPTH`.

    It is 0 if the density or the length is 0, even if the other is infinite. NaN densities stay NaN, so that a broken
    field is noticed. The density of an infinite interval has no gradient, because its optical depth is 0 or the
    maximum.

    Args:
        sigma: (N,) density in 1/length, at least 0.
        deltas: (N,) length of each interval.
    """
    # Infinity times 0 would be NaN, in tau and in its gradient, so infinity is replaced by the largest finite number.
    lengths = deltas.clamp(max=torch.finfo(deltas.dtype).max)
    sigma = torch.where(deltas == torch.inf, sigma.detach(), sigma).clamp(max=torch.finfo(sigma.dtype).max)
    return (sigma * lengths).clamp(max=MAX_OPTICAL_DEPTH)


def exclusive_cumsum(values: Tensor) -> Tensor:
    """Return the exclusive cumulative sum (..., S) of `values` (..., S) along the last dimension.

    The inclusive sums are shifted by one. Subtracting each value from its inclusive sum would leave rounding errors of
    large values.
    """
    return functional.pad(values, (1, 0)).cumsum(-1)[..., :-1]


def segmented_sum(values: Tensor, places: Tensor) -> Tensor:
    """Return the exclusive cumulative sum (N,) of `values` (N,) within each ray.

    Values of different rays are never added, so that NaN and rounding errors stay in their ray. The sums take log2 S
    passes (Hillis and Steele 1986), without padding to the longest ray.

    Args:
        values: (N,) one value per sample.
        places: (N,) int64 number of samples in front of each sample on its ray.
    """
    most = int(places.max()) if len(places) else 0
    total, reach = values.roll(1).masked_fill(places < 1, 0), 1
    while reach < most:
        total = total + total.roll(reach).masked_fill(places < reach, 0)
        reach *= 2
    return total


def bounded_sum(values: Tensor, owners: Tensor, places: Tensor, num_rays: int, longest: int) -> Tensor:
    """Return `segmented_sum` of `values` (N,) if the number of samples on a ray has an upper bound.

    Rays are padded to the bound unless that takes too much memory; there is no wait for the device.

    Args:
        values: (N,) one value per sample.
        owners: (N,) int64 ray of each sample.
        places: (N,) int64 number of samples in front of each sample on its ray.
        num_rays: number of rays.
        longest: upper bound of the number of samples on a ray.
    """
    width = longest + 1
    if num_rays * width > MAX_PADDED:
        return segmented_sum(values, places)
    slots = owners * width + places
    padded = values.new_zeros(num_rays * width).index_copy_(0, slots + 1, values)  # one position after its own
    return padded.view(num_rays, width).cumsum(-1).view(-1).index_select(0, slots)


def exclusive_sum(values: Tensor, samples: Samples) -> Tensor:
    """Return the sum (N,) of `values` (N,) over the samples in front of each of `samples` on its ray."""
    if samples.per_ray is not None:
        return exclusive_cumsum(samples.padded(values)).reshape(-1)
    if samples.longest is not None:
        return bounded_sum(values, samples.ray_indices, samples.ranks, samples.num_rays, samples.longest)
    return segmented_sum(values, samples.ranks)


def ray_sum(values: Tensor, samples: Samples) -> Tensor:
    """Return the sum (R, ...) of `values` (N, ...) over the `samples` of each ray; 0 for a ray without samples."""
    if samples.per_ray is not None:
        return samples.padded(values).sum(1)
    total = values.new_zeros(samples.num_rays, *values.shape[1:])
    return total.index_add(0, samples.ray_indices, values)


def weights_and_transmittance(sigma: Tensor, samples: Samples) -> tuple[Tensor, Tensor]:
    """Return the weight (N,) of each sample and the transmittance (N,) in front of it.

    Args:
        sigma: (N,) density in 1/length, at least 0.
        samples: N samples.
    """
    tau = optical_depth(sigma, samples.deltas)
    transmittance = torch.exp(-exclusive_sum(tau, samples))
    return transmittance * -torch.expm1(-tau), transmittance


class Composited(NamedTuple):
    """Composited values of R rays with N samples."""

    color: Tensor
    """(R, 3) colour over the background."""
    opacity: Tensor
    """(R,) sum of the weights."""
    moment: Tensor
    """(R,) sum of weight * t, without gradient."""
    median: Tensor
    """(R,) t of the first sample with a transmittance of at most 0.5 behind it, or the far end; without gradient."""
    weights: Tensor
    """(N,) weight of each sample."""


def composite_reference(samples: Samples, sigma: Tensor, rgb: Tensor, background: Tensor, fars: Tensor) -> Composited:
    """Compute `composite` of `samples`, `sigma`, `rgb`, `background` and `fars` in PyTorch, for any float type."""
    weights, transmittance = weights_and_transmittance(sigma, samples)
    opacity = ray_sum(weights, samples)
    left = (1 - opacity).clamp(min=0)
    color = ray_sum(weights[:, None] * rgb, samples) + left[:, None] * background
    with torch.no_grad():
        # t is infinite in the middle of an infinite interval; with weight 0 it must not make the mean NaN.
        moment = ray_sum((weights * samples.t).masked_fill(weights == 0, 0), samples)
        far = fars[samples.ray_indices]
        crossing = torch.where(transmittance - weights <= 0.5, torch.minimum(samples.t, far), far)
        median = fars.to(crossing.dtype).scatter_reduce(0, samples.ray_indices, crossing, "amin")
    return Composited(color, opacity, moment, median, weights)


_forward = native.Function("composite_forward", "ppppppqqpppppppi")
_backward = native.Function("composite_backward", "pppppqqppppppppi")


class _Composite(torch.autograd.Function):
    """The compiled form of `composite`: one pass over each ray forward, two backward."""

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
        grad_color = torch.zeros_like(background) if grads[0] is None else grads[0].contiguous()
        grad_opacity, grad_weights = (None if g is None else g.contiguous() for g in (grads[1], grads[4]))
        grad_sigma, grad_rgb = torch.empty_like(sigma), torch.empty_like(rgb)
        _backward(
            sigma.data_ptr(), rgb.data_ptr(), starts.data_ptr(), ends.data_ptr(), offsets.data_ptr(), rays, count,
            background.data_ptr(), weights.data_ptr(), opacity.data_ptr(),
            native.pointer(grad_color, "the colour's gradient", (rays, 3)),
            None if grad_opacity is None else native.pointer(grad_opacity, "the opacity's gradient", (rays,)),
            None if grad_weights is None else native.pointer(grad_weights, "the weights' gradient", (count,)),
            grad_sigma.data_ptr(), grad_rgb.data_ptr(), native.threads(),
        )  # fmt: skip
        return grad_sigma, grad_rgb, None, None, None, None, None, None


def composite(samples: Samples, sigma: Tensor, rgb: Tensor, background: Tensor, fars: Tensor) -> Composited:
    """Composite packed samples: NeRF (Mildenhall et al. 2020), equation 3.

    Args:
        samples: N samples of R rays.
        sigma: (N,) density in 1/length, at least 0.
        rgb: (N, 3) colour in [0, 1].
        background: (R, 3) or (3,) colour in [0, 1] of the background.
        fars: (R,) distance of the far end of each ray.

    Returns:
        Colour, opacity and depth of R rays, and the weights.

    Raises:
        IndexError: if the offsets of the samples do not divide them between the rays.
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


COMPOSITE.implementation(TRITON, differentiable=2)(later("compositing.density_triton", "composite"))


def distortion_reference(weights: Tensor, samples: Samples) -> Tensor:
    """Compute `distortion` of `weights` and `samples` in PyTorch, on any device and for any float type."""
    # m_i - m_j is the sum of the gaps between neighbouring middles from j to i, so each gap is multiplied by the sum of
    # the weights in front of it. No term is negative, so there is no cancellation.
    starts, ends = samples.t_starts, samples.t_ends
    gaps = ((starts - starts.roll(1)) + (ends - ends.roll(1))).masked_fill(samples.ranks == 0, 0) / 2
    steps = gaps * exclusive_sum(weights, samples)
    apart = exclusive_sum(steps, samples) + steps
    return ray_sum(weights * (2 * apart + weights * samples.deltas / 3), samples)


_distortion = native.Function("distortion", "ppppqqppi")


class _Distortion(torch.autograd.Function):
    """The distortion (R,), computed together with its gradient (N,) by the weights."""

    @staticmethod
    def forward(ctx: Any, computed: tuple[Tensor, Tensor], offsets: Tensor, weights: Tensor) -> Tensor:
        loss, gradient = computed
        ctx.save_for_backward(gradient, offsets)
        return loss

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[None, None, Tensor]:
        gradient, offsets = ctx.saved_tensors
        return None, None, gradient * grad.repeat_interleave(offsets[1:] - offsets[:-1], output_size=len(gradient))


def distortion(weights: Tensor, samples: Samples) -> Tensor:
    """Return the distortion of rays, the spread of their weights: mip-NeRF 360 (Barron et al. 2022), equation 15.

    The time is proportional to the number of samples, not of pairs.

    Args:
        weights: (N,) weight of each sample.
        samples: N samples of R rays.

    Returns:
        (R,) sum_ij w_i w_j |m_i - m_j| + sum_i w_i^2 delta_i / 3, in the unit of t, where m_i is the middle of
        interval i.

    Raises:
        IndexError: if the offsets of the samples do not divide them between the rays.
    """
    check_offsets(samples.offsets, len(samples))
    return DISTORTION((weights, samples.t_starts, samples.t_ends), weights, samples)


DISTORTION = Operation("distortion", distortion_reference)


@DISTORTION.implementation(CPP, differentiable=1)
def _distortion_compiled(weights: Tensor, samples: Samples) -> Tensor:
    weights, starts, ends = (tensor.contiguous() for tensor in (weights, samples.t_starts, samples.t_ends))
    count, rays, offsets = len(weights), samples.num_rays, samples.offsets
    loss, gradient = weights.new_empty(rays), torch.empty_like(weights)
    _distortion(
        native.pointer(weights, "weights", (count,)), native.pointer(starts, "t_starts", (count,)),
        native.pointer(ends, "t_ends", (count,)), native.pointer(offsets, "offsets", (rays + 1,), torch.int64),
        rays, count, loss.data_ptr(), gradient.data_ptr(), native.threads(),
    )  # fmt: skip
    return _Distortion.apply((loss, gradient), offsets, weights)


DISTORTION.implementation(TRITON, differentiable=1)(later("compositing.density_triton", "distortion"))
