"""Samples where rays meet the zero level set of a signed distance, for pictures by the surface."""

from __future__ import annotations

import torch

from nerfloom.fields.base import Field
from nerfloom.fields.surface import SurfaceField
from nerfloom.geometry.points import Points
from nerfloom.geometry.rays import Rays, Samples
from nerfloom.kernels.compositing.alpha import LEFT_BEHIND
from nerfloom.kernels.surfaces.crossings import Crossings, crossings, marched_crossings, pieces_of
from nerfloom.samplers.occupancy import OccupancySampler
from nerfloom.samplers.wrapping import WrappingSampler

SAFETY = 1.25
"""Maximum slope of a learnt distance along a step, relative to its slope at the position where it was evaluated."""
SHORTEST = 1 / 8
"""Minimum advance, in steps of the sampler."""


class FirstCrossing(WrappingSampler):
    """Samples of `sampler`, or with `traces` in evaluation those where a ray meets a surface, to the covering one."""

    sampler: OccupancySampler

    def __init__(self, sampler: OccupancySampler, traces: bool) -> None:
        super().__init__(sampler)
        self.traces = traces
        self.evaluations = 0
        """Number of evaluations for the last traced rays."""

    def sample(self, rays: Rays, field: Field, jitter: bool) -> Samples:
        if self.training or not self.traces:
            return self.sampler.sample(rays, field, jitter)
        assert isinstance(field, SurfaceField)
        with torch.no_grad():
            met = self.crossings(rays, field)
            self.evaluations = met.evaluations + len(met.t)
            counts = torch.bincount(met.owners, minlength=len(rays))
            offsets = torch.cat([counts.new_zeros(1), counts.cumsum(0)])
            _, features = field.density(Points(rays.points(met.owners, met.t)))
        samples = Samples(met.t, met.t, offsets, owners=met.owners, early_stop=LEFT_BEHIND)
        return samples.with_alpha(met.coverage, features)

    def crossings(self, rays: Rays, field: SurfaceField) -> Crossings:
        """Return where `rays` meet the surface of `field` in occupied cells."""
        marched, shortest = self.sampler.begin(rays, False, 0.0), SHORTEST * self.sampler.step_size
        known = field.distance.known()
        if known is None:
            return crossings(field.reach(SAFETY), rays, pieces_of(marched), shortest)
        return marched_crossings(marched, known, shortest, SAFETY)
