"""Histograms along rays: weights of intervals, resampling by weight, and the loss of proposals.

Letters: R rays, B bins of a histogram, which has B + 1 sorted edges on every ray.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from nerfloom.kernels import native
from nerfloom.kernels.compositing.density import exclusive_cumsum, optical_depth
from nerfloom.kernels.dispatch import CPP, TRITON, Operation
from nerfloom.kernels.known_gradient import KnownGradient
from nerfloom.kernels.triton_backend import later

EPS = 1e-7
"""Added to weights in a denominator, so that the loss of intervals with weight 0 is finite."""


# -- weights ------------------------------------------------------------------------------------------------------


def interval_weights_reference(sigma: Tensor, t: Tensor) -> Tensor:
    """Compute `interval_weights` of `sigma` and `t` in PyTorch, on any device and for any float type."""
    tau = optical_depth(sigma, t.diff(dim=-1))
    in_front = torch.exp(-exclusive_cumsum(tau))
    return in_front * -torch.expm1(-tau)


def interval_weights(sigma: Tensor, t: Tensor) -> Tensor:
    """Return the weights (R, B) of intervals: NeRF, equation 3.

    Args:
        sigma: (R, B) density of each interval, 1/length.
        t: (R, B + 1) sorted ends of the intervals, distances along the rays; without a gradient.
    """
    t = t.detach()
    return INTERVAL_WEIGHTS((sigma, t), sigma, t)


INTERVAL_WEIGHTS = Operation("interval_weights", interval_weights_reference)


@INTERVAL_WEIGHTS.implementation(CPP)
def _interval_weights(sigma: Tensor, t: Tensor) -> Tensor:
    return _Weights.apply(sigma.contiguous(), t.contiguous())


INTERVAL_WEIGHTS.implementation(TRITON)(later("histograms.intervals_triton", "interval_weights"))


_weights = native.Function("interval_weights", "ppqqpi")
_weights_backward = native.Function("interval_weights_backward", "ppppqqpi")


class _Weights(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, sigma: Tensor, t: Tensor) -> Tensor:
        rays, bins = sigma.shape
        out = torch.empty_like(sigma)
        _weights(
            native.pointer(sigma, "sigma", (rays, bins)), native.pointer(t, "t", (rays, bins + 1)), rays, bins,
            out.data_ptr(), native.threads(),
        )  # fmt: skip
        ctx.save_for_backward(sigma, t, out)
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        sigma, t, weights = ctx.saved_tensors
        out, grad = torch.empty_like(sigma), grad.contiguous()
        _weights_backward(
            sigma.data_ptr(), t.data_ptr(), weights.data_ptr(), native.pointer(grad, "gradient", sigma.shape),
            *sigma.shape, out.data_ptr(), native.threads(),
        )  # fmt: skip
        return out, None


# -- new intervals ------------------------------------------------------------------------------------------------


def resample_reference(
    edges: Tensor, weights: Tensor, shift: Tensor, count: int, power: float | Tensor, padding: float
) -> Tensor:
    """Compute `resample` of `edges`, `weights`, `shift`, `count`, `power` and `padding` in PyTorch."""
    heavy = weights.to(torch.promote_types(weights.dtype, edges.dtype)) ** power + padding
    cdf = torch.cat([torch.zeros_like(heavy[:, :1]), heavy.cumsum(-1)], dim=-1)
    steps = torch.arange(count + 1, device=edges.device)
    u = cdf[:, -1:] * (steps + shift[:, None]) / (count + 1)
    above = torch.searchsorted(cdf, u.contiguous(), right=True).clamp(1, heavy.shape[-1])
    low, width = cdf.gather(-1, above - 1), heavy.gather(-1, above - 1)
    empty = width <= 0
    share = torch.where(empty, torch.zeros_like(u), (u - low) / torch.where(empty, torch.ones_like(u), width))
    return torch.lerp(edges.gather(-1, above - 1), edges.gather(-1, above), share.clamp(0, 1))


@torch.no_grad()
def resample(
    edges: Tensor, weights: Tensor, shift: Tensor, count: int, power: float | Tensor, padding: float
) -> Tensor:
    """Return the edges (R, count + 1) of new intervals with equal shares of the weight of a histogram.

    Args:
        edges: (R, B + 1) sorted edges of the histogram.
        weights: (R, B) weights of its bins.
        shift: (R,) in [0, 1): the new edges are the quantiles (j + shift) / (count + 1), for j from 0 to count.
        count: number of new intervals.
        power: exponent of the weights, possibly on the device, () float32; less than 1 flattens them (mip-NeRF 360,
            section 3.1).
        padding: added to each weight after the exponentiation, so that every bin can be drawn.
    """
    return RESAMPLE((edges, weights, shift), edges, weights, shift, count, power, padding)


RESAMPLE = Operation("resample", resample_reference)


@RESAMPLE.implementation(CPP, fits=lambda edges, weights, shift, count, power, padding: not isinstance(power, Tensor))
def _resample(
    edges: Tensor, weights: Tensor, shift: Tensor, count: int, power: float | Tensor, padding: float
) -> Tensor:
    rays, bins = weights.shape
    out = edges.new_empty(rays, count + 1)
    edges, weights = edges.contiguous(), weights.contiguous()
    _resample_intervals(
        native.pointer(edges, "edges", (rays, bins + 1)), native.pointer(weights, "weights", (rays, bins)),
        native.pointer(shift, "shift", (rays,)), rays, bins, count, power, padding, out.data_ptr(), native.threads(),
    )  # fmt: skip
    return out


RESAMPLE.implementation(TRITON)(later("histograms.intervals_triton", "resample"))


_resample_intervals = native.Function("resample_intervals", "pppqqqffpi")


# -- the loss of a proposal ---------------------------------------------------------------------------------------


def proposal_excess_reference(edges: Tensor, weights: Tensor, proposed: Tensor, proposed_weights: Tensor) -> Tensor:
    """Compute `proposal_excess` of `edges`, `weights`, `proposed` and `proposed_weights` from pairs of intervals."""
    touches = (proposed[:, None, :-1] <= edges[:, 1:, None]) & (proposed[:, None, 1:] >= edges[:, :-1, None])
    bound = (touches * proposed_weights[:, None, :]).sum(-1)
    return ((weights - bound).clamp(min=0).square() / (weights + EPS)).sum(-1)


def proposal_excess(edges: Tensor, weights: Tensor, proposed: Tensor, proposed_weights: Tensor) -> Tensor:
    """Return the loss (R,) of proposed histograms that should bound others from above: mip-NeRF 360, equation 13.

    Args:
        edges: (R, B + 1) sorted edges of the histogram to be bounded; without a gradient.
        weights: (R, B) weights of its bins; without a gradient.
        proposed: (R, P + 1) sorted edges of the proposed histogram; without a gradient.
        proposed_weights: (R, P) weights of its bins.
    """
    edges, weights, proposed = edges.detach(), weights.detach(), proposed.detach()
    tensors = edges, weights, proposed, proposed_weights
    return PROPOSAL_EXCESS(tensors, *tensors)


PROPOSAL_EXCESS = Operation("proposal_excess", proposal_excess_reference)


@PROPOSAL_EXCESS.implementation(CPP)
def _proposal_excess(edges: Tensor, weights: Tensor, proposed: Tensor, proposed_weights: Tensor) -> Tensor:
    inputs = (tensor.contiguous() for tensor in (edges, weights, proposed, proposed_weights))
    edges, weights, proposed, proposed_weights = inputs
    (rays, bins), proposed_bins = weights.shape, proposed_weights.shape[1]
    loss, gradient = weights.new_empty(rays), torch.empty_like(proposed_weights)
    _excess(
        native.pointer(edges, "edges", (rays, bins + 1)), native.pointer(weights, "weights", (rays, bins)), bins,
        native.pointer(proposed, "proposed edges", (rays, proposed_bins + 1)),
        native.pointer(proposed_weights, "proposed weights", (rays, proposed_bins)), proposed_bins, rays, EPS,
        loss.data_ptr(), gradient.data_ptr(), native.threads(),
    )  # fmt: skip
    return KnownGradient.apply((loss, gradient), proposed_weights)


PROPOSAL_EXCESS.implementation(TRITON)(later("histograms.intervals_triton", "proposal_excess"))


_excess = native.Function("proposal_excess", "ppqppqqfppi")
