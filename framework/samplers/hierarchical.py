"""Hierarchical (coarse-to-fine) sampling: NeRF (Mildenhall et al. 2020), section 5.2."""

from __future__ import annotations

import torch

from framework.fields.base import Field
from framework.geometry.points import sample_points
from framework.geometry.rays import CoarseLevel, Rays, Samples
from framework.kernels.intervals import interval_weights
from framework.samplers.base import Sampler
from framework.samplers.inverse_cdf import inverse_cdf, uniform_variates
from framework.samplers.uniform import samples_from_points, stratified_points

LEAST_COARSE = 3
"""Minimum number of stratified samples per ray; fine samples are drawn from the weights between first and last."""


class HierarchicalSampler(Sampler):
    """Stratified samples, and further ones drawn from the weights that a coarse field has at the stratified ones.

    The coarse field belongs to the sampler, and is rendered and supervised too (`Samples.coarse`).

    Args:
        coarse: the coarse field.
        num_coarse: stratified samples per ray.
        num_fine: samples per ray drawn from the weights; the fine field is evaluated at both kinds.

    Raises:
        ValueError: if there are fewer than 3 stratified samples, which leave no weights between first and last.
    """

    def __init__(self, coarse: Field, num_coarse: int = 64, num_fine: int = 128) -> None:
        super().__init__()
        if num_coarse < LEAST_COARSE:
            raise ValueError(f"{num_coarse} stratified samples cannot say where to look: at least {LEAST_COARSE} can")
        self.coarse, self.num_coarse, self.num_fine = coarse, num_coarse, num_fine

    def sample(self, rays: Rays, field: Field, jitter: bool) -> Samples:
        t = stratified_points(rays, self.num_coarse, jitter)
        samples = samples_from_points(t)
        samples = samples.evaluated(*self.coarse.density(sample_points(rays, samples, self.coarse.footprint)))
        assert samples.sigma is not None
        edges = torch.cat([t, samples.padded(samples.t_ends)[:, -1:]], dim=-1)
        weights = interval_weights(samples.sigma.detach().view(t.shape), edges)
        middles = (t[:, 1:] + t[:, :-1]) / 2
        drawn = inverse_cdf(middles, weights[:, 1:-1], uniform_variates(len(rays), self.num_fine, jitter, t.device))
        merged = samples_from_points(torch.cat([t, drawn], dim=-1).sort(dim=-1).values)
        return Samples(
            merged.t_starts,
            merged.t_ends,
            merged.offsets,
            merged.points,
            merged.per_ray,
            coarse=CoarseLevel(self.coarse, samples),
        )
