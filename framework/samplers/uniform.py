"""Samples in bins of equal length between near and far: NeRF, equation 2."""

from __future__ import annotations

import torch
from torch import Tensor

from framework.fields.base import Field
from framework.geometry.rays import Rays, Samples
from framework.samplers.base import Sampler

LAST_INTERVAL = 1e10
"""The authors' code lets the last sample stand for everything behind it."""


def stratified_points(rays: Rays, count: int, jitter: bool) -> Tensor:
    """(R, count) distances, one in each of `count` equal bins: random in its bin, or its middle."""
    within = rays.nears.new_full((len(rays), count), 0.5)
    within = torch.rand_like(within) if jitter else within
    fraction = (torch.arange(count, device=rays.nears.device) + within) / count
    return torch.lerp(rays.nears[:, None], rays.fars[:, None], fraction)


def samples_from_points(points: Tensor) -> Samples:
    """Point samples (R, S), sorted, as NeRF's quadrature takes them: the interval of point i ends at point i + 1."""
    ends = torch.cat([points[:, 1:], points[:, -1:] + LAST_INTERVAL], dim=-1)
    return Samples.regular(points, ends, points)


class UniformSampler(Sampler):
    """Samples between near and far on every ray, one in each of so many equal bins.

    Args:
        count: samples on a ray.
    """

    def __init__(self, count: int) -> None:
        super().__init__()
        self.count = count

    def sample(self, rays: Rays, field: Field, jitter: bool) -> Samples:
        edges = torch.linspace(0, 1, self.count + 1, device=rays.nears.device, dtype=rays.nears.dtype)
        t = torch.lerp(rays.nears[:, None], rays.fars[:, None], edges)
        points = stratified_points(rays, self.count, jitter)
        return Samples.regular(t[:, :-1], t[:, 1:], points)
