"""Compositing: from densities to the weight of each sample.

Max 1995, and NeRF (Mildenhall et al. 2020) equation 3, for intervals of constant density:

    tau_i = sigma_i * delta_i                   optical depth of an interval
    T_i   = exp(-sum_{j < i} tau_j)             transmittance in front of it
    w_i   = T_i * (1 - exp(-tau_i))             weight

Optical depth is summed and exponentiated, and alpha is -expm1(-tau): products of (1 - alpha) lose every
optical depth below 6e-8, so that a thousand thin samples would vanish.
"""

from __future__ import annotations

import torch
from torch import Tensor

from framework.rays import Samples

MAX_OPTICAL_DEPTH = 1e3
"""Of one interval. exp(-1000) is 0 even in float64, so nothing is lost, and sums stay finite."""


def optical_depth(sigma: Tensor, deltas: Tensor) -> Tensor:
    """tau (N,) = sigma * delta, in [0, MAX_OPTICAL_DEPTH]; an interval of zero length has none, whatever sigma.

    NaN densities stay NaN: a broken field must be seen.
    """
    sigma = sigma.clamp(max=torch.finfo(sigma.dtype).max)  # inf * 0 would be NaN
    return (sigma * deltas).clamp(max=MAX_OPTICAL_DEPTH)


def exclusive_sum(values: Tensor, samples: Samples) -> Tensor:
    """(N,) sum of `values` (N,) over the samples in front on the same ray."""
    if samples.per_ray is not None:
        padded = samples.padded(values)
        return (padded.cumsum(-1) - padded).reshape(-1)
    # One running sum over all rays, minus its value where the ray starts: float64, which Apple's GPUs lack, keeps
    # what cancels.
    running = (values if values.device.type == "mps" else values.double()).cumsum(0)
    before = running - values
    starts = torch.cat([running.new_zeros(1), running])[samples.offsets[:-1]]
    return (before - starts[samples.ray_indices]).to(values.dtype)


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
    transmittance = torch.exp(-exclusive_sum(tau, samples).clamp(min=0))
    return transmittance * -torch.expm1(-tau), transmittance
