"""Hierarchical (coarse-to-fine) sampling: NeRF (Mildenhall et al. 2020), section 5.2, and Mip-NeRF's, section 3.2."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from nerfloom.base.step_kind import StepKind
from nerfloom.fields.base import Field
from nerfloom.geometry.points import sample_points
from nerfloom.geometry.rays import CoarseLevel, Rays, Samples
from nerfloom.kernels.histograms.intervals import interval_weights, resample
from nerfloom.kernels.histograms.inverse_cdf import inverse_cdf, uniform_variates
from nerfloom.samplers.base import Sampler
from nerfloom.samplers.uniform import samples_from_points, stratified_points

MIN_COARSE = 3
"""Minimum number of stratified samples per ray; fine samples are drawn from the weights between first and last."""
PADDING = 0.01
"""Added to the blurred weights of intervals, so that every interval can be drawn: Mip-NeRF, equation 18."""


class HierarchicalSampler(Sampler):
    """Stratified samples, and further samples drawn from a coarse field's weights at the stratified ones.

    The coarse level is rendered and supervised too (`Samples.coarse`). There are two kinds of coarse level:

    - A separate coarse field of the sampler, evaluated at points: NeRF. The fine field is evaluated at the points of
      both levels.
    - The field itself, evaluated in intervals: Mip-NeRF, where one network takes cones of any length. The intervals of
      the fine level are drawn from the blurred weights of the coarse intervals and replace them.

    Args:
        coarse: the coarse field; None for the field itself.
        num_coarse: stratified samples per ray.
        num_fine: samples per ray drawn from the weights.

    Raises:
        ValueError: if there are fewer than 3 stratified samples, so that no weights remain between first and last.
    """

    has_coarse_level = True

    def __init__(self, coarse: Field | None, num_coarse: int = 64, num_fine: int = 128) -> None:
        super().__init__()
        if num_coarse < MIN_COARSE:
            raise ValueError(f"{num_coarse} stratified samples are too few; at least {MIN_COARSE} are needed")
        self.coarse, self.num_coarse, self.num_fine = coarse, num_coarse, num_fine

    def sample(self, rays: Rays, field: Field, jitter: bool) -> Samples:
        if self.coarse is None:
            return self._of_intervals(rays, field, jitter)
        return self._of_points(rays, self.coarse, jitter)

    def step_kind(self, step: int) -> StepKind:
        return StepKind()

    def _of_points(self, rays: Rays, coarse: Field, jitter: bool) -> Samples:
        t = stratified_points(rays, self.num_coarse, jitter)
        samples = samples_from_points(t)
        samples = samples.evaluated(*coarse.density(sample_points(rays, samples, coarse.footprint)))
        assert samples.sigma is not None
        edges = torch.cat([t, samples.padded(samples.t_ends)[:, -1:]], dim=-1)
        weights = interval_weights(samples.sigma.detach().view(t.shape), edges)
        middles = (t[:, 1:] + t[:, :-1]) / 2
        drawn = inverse_cdf(middles, weights[:, 1:-1], uniform_variates(len(rays), self.num_fine, jitter, t.device))
        merged = samples_from_points(torch.cat([t, drawn], dim=-1).sort(dim=-1).values)
        return replace(merged, coarse=CoarseLevel(coarse, samples))

    def _of_intervals(self, rays: Rays, field: Field, jitter: bool) -> Samples:
        edges = stratified_edges(rays, self.num_coarse, jitter)
        coarse = Samples.regular(edges[:, :-1], edges[:, 1:])
        coarse = coarse.evaluated(*field.density(sample_points(rays, coarse, field.footprint)))
        assert coarse.sigma is not None
        weights = interval_weights(coarse.sigma.detach().view(-1, self.num_coarse), edges)
        shift = torch.rand(len(rays), device=edges.device) if jitter else torch.full_like(edges[:, 0], 0.5)
        drawn = resample(edges, blurred(weights), shift, self.num_fine, 1.0, PADDING)
        return replace(Samples.regular(drawn[:, :-1], drawn[:, 1:]), coarse=CoarseLevel(field, coarse))


def stratified_edges(rays: Rays, count: int, jitter: bool) -> Tensor:
    """Return edges (R, count + 1) of `count` intervals of `rays`, equal or, with `jitter`, moved by up to half."""
    place = torch.arange(count + 1, device=rays.nears.device, dtype=rays.nears.dtype).expand(len(rays), -1)
    if jitter:
        moved = place[:, 1:-1] + torch.rand_like(place[:, 1:-1]) - 0.5
        place = torch.cat([place[:, :1], moved, place[:, -1:]], dim=-1)
    return torch.lerp(rays.nears[:, None], rays.fars[:, None], place / count)


def blurred(weights: Tensor) -> Tensor:
    """Return a blurred envelope of weights (R, B), never below the weights themselves: Mip-NeRF, equation 18.

    It is a maximum of two neighbours, then a mean of two, so that samples are drawn also beside intervals with weight.
    Mip-NeRF also adds a constant (`PADDING`).

    Args:
        weights: (R, B) weights of intervals.
    """
    wide = torch.cat([weights[:, :1], weights, weights[:, -1:]], dim=-1)
    highest = torch.maximum(wide[:, 1:], wide[:, :-1])
    return (highest[:, 1:] + highest[:, :-1]) / 2
