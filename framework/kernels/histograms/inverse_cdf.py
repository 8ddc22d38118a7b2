"""Inverse-transform sampling of a piecewise-constant density: NeRF, section 5.2."""

from __future__ import annotations

import torch
from torch import Tensor


def inverse_cdf(edges: Tensor, weights: Tensor, u: Tensor, padding: float = 1e-5) -> Tensor:
    """Return points drawn from histograms, by inverting the cumulative distribution.

    Args:
        edges: (R, B + 1) sorted edges of the bins.
        weights: (R, B) weights of the bins, at least 0, not necessarily normalised.
        u: (R, S) values of the cumulative distribution in [0, 1], random or evenly spaced, in any order.
        padding: added to each weight, so that all bins are drawn equally often on a ray with zero weights.

    Returns:
        (R, S) points in [edges[:, 0], edges[:, -1]], in the order of `u`.
    """
    weights = weights.to(torch.promote_types(weights.dtype, edges.dtype)) + padding
    cdf = torch.cumsum(weights / weights.sum(-1, keepdim=True), dim=-1)
    # Rounding leaves the last value about 1e-7 from 1, so it is set to exactly 1.
    cdf = torch.cat([torch.zeros_like(cdf[:, :1]), cdf[:, :-1].clamp(max=1), torch.ones_like(cdf[:, :1])], dim=-1)
    above = torch.searchsorted(cdf, u.contiguous(), right=True).clamp(1, weights.shape[-1])
    low, high = cdf.gather(-1, above - 1), cdf.gather(-1, above)
    width = high - low
    empty = width <= 0
    fraction = torch.where(empty, torch.zeros_like(u), (u - low) / torch.where(empty, torch.ones_like(u), width))
    return torch.lerp(edges.gather(-1, above - 1), edges.gather(-1, above), fraction.clamp(0, 1))


def uniform_variates(num_rays: int, count: int, jitter: bool, device: torch.device) -> Tensor:
    """Return values u (R, count) in [0, 1] for `inverse_cdf`.

    Args:
        num_rays: R.
        count: number of values per ray.
        jitter: True for independent, uniform random values (training), False for evenly spaced ones (evaluation).
        device: device of the result.
    """
    if jitter:
        return torch.rand(num_rays, count, device=device)
    return ((torch.arange(count, device=device) + 0.5) / count).expand(num_rays, count)
