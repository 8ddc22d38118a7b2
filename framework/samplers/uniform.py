"""Samples in bins of equal length between near and far: NeRF, equation 2."""

from __future__ import annotations

import torch
from torch import Tensor

from nerfloom.fields.base import Field
from nerfloom.geometry.rays import Rays, Samples
from nerfloom.samplers.base import Sampler

LAST_INTERVAL = 1e10
"""Length of the last interval, scene units, as in the authors' code; the last sample represents everything behind
it."""


def stratified_points(rays: Rays, count: int, jitter: bool) -> Tensor:
    """Return distances (R, count), one in each of `count` equal bins of `rays`: the middle, or random with `jitter`."""
    within = rays.nears.new_full((len(rays), count), 0.5)
    within = torch.rand_like(within) if jitter else within
    fraction = (torch.arange(count, device=rays.nears.device) + within) / count
    return torch.lerp(rays.nears[:, None], rays.fars[:, None], fraction)


def samples_from_points(points: Tensor) -> Samples:
    """Return samples at `points` (R, S), sorted distances, where the interval of point i ends at point i + 1.

    This is the quadrature of NeRF, equation 3. The last interval of a ray has the length `LAST_INTERVAL`.
    """
    ends = torch.cat([points[:, 1:], points[:, -1:] + LAST_INTERVAL], dim=-1)
    return Samples.regular(points, ends, points)


class UniformSampler(Sampler):
    """One sample in each of `count` bins of equal length between the near and far end of every ray."""

    def __init__(self, count: int) -> None:
        super().__init__()
        self.count = count

    def sample(self, rays: Rays, field: Field, jitter: bool) -> Samples:
        edges = torch.linspace(0, 1, self.count + 1, device=rays.nears.device, dtype=rays.nears.dtype)
        t = torch.lerp(rays.nears[:, None], rays.fars[:, None], edges)
        points = stratified_points(rays, self.count, jitter)
        return Samples.regular(t[:, :-1], t[:, 1:], points)
