"""Every sampler of the framework, ready to render a scene, with evaluations of the field counted.

They are counted where they are asked for, those whose result was dropped in the end included. Those of a coarse field
or of proposals are counted apart, for proposals are much smaller than the field.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

from framework.base.device import seed_step, stream_seed
from framework.fields.base import Field
from framework.geometry.points import Points
from framework.geometry.rays import Rays
from framework.rendering.rendered import Rendered
from framework.rendering.volume import VolumeRenderer
from framework.samplers.base import Sampler
from framework.samplers.hierarchical import HierarchicalSampler
from framework.samplers.occupancy import OccupancySampler
from framework.samplers.proposal import ProposalSampler, interlevel_loss
from framework.samplers.uniform import UniformSampler
from framework.tools.benchmarks.closed_forms import BOX

WHITE = torch.ones(3)
"""The background."""
DISTANCE, NEAR, FAR = 4.0, 2.0, 6.0
"""Of the eye from the scene's middle, and a ray's ends: as in NeRF's synthetic scenes."""
EARLY_STOP = 1e-4
"""Transmittance at which the sampler "early stop" ends a ray: the framework's own when it renders."""
GRID_STEPS = 1024
"""Training steps in which an occupancy grid is filled: those of its shuffled visits, and three times as many."""
FIT_RAYS = 1024
"""In a step of fitting proposals."""


def random_rays(count: int, seed: int) -> Rays:
    """From all sides, towards places spread evenly in the largest ball that the scene's box holds."""
    draws = torch.Generator().manual_seed(seed)
    origins, outwards = (normalize(torch.randn(count, 3, generator=draws), dim=-1) for _ in range(2))
    origins, places = DISTANCE * origins, outwards * torch.rand(count, 1, generator=draws) ** (1 / 3)
    ends = torch.full((count,), NEAR), torch.full((count,), FAR)
    return Rays(origins, normalize(places - origins, dim=-1), *ends)


# -- rendering ----------------------------------------------------------------------------------------------------


class Picture(NamedTuple):
    """What a sampler made of R rays."""

    color: Tensor
    """(R, 3)"""
    evaluations: int
    """Of the field."""
    coarse_evaluations: int
    """Of what says where to look."""


Renderer = Callable[[Rays], Picture]


class Counted(Field):
    """A field that counts at how many positions its density is asked for."""

    def __init__(self, field: Field) -> None:
        super().__init__()
        self.field, self.count = field, 0

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        self.count += len(points)
        return self.field.density(points)

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        return self.field.color(features, directions, camera_indices)


def render(field: Field, sampler: Sampler, rays: Rays, jitter: bool) -> Rendered:
    """Return what a field shows, by a sampler, over white.

    Args:
        field: density and colour.
        sampler: where the field is asked.
        rays: R rays.
        jitter: random positions or fixed ones.
    """
    return VolumeRenderer().render(rays, sampler.sample(rays, field, jitter), field, WHITE)


def sampled(scene: Field, sampler: Sampler, jitter: bool, rays: Rays) -> Picture:
    """By a sampler that asks nothing but the field."""
    field = Counted(scene)
    return Picture(render(field, sampler, rays, jitter).rgb, field.count, 0)


def hierarchical(scene: Field, counts: tuple[int, int], rays: Rays) -> Picture:
    """By inverting the distribution that stratified samples found, the field being its own coarse one."""
    coarse, fine = Counted(scene), Counted(scene)
    sampler = HierarchicalSampler(coarse, *counts)
    return Picture(render(fine, sampler, rays, False).rgb, fine.count, coarse.count)


def proposed(scene: Field, sampler: ProposalSampler, counts: tuple[int, ...], rays: Rays) -> Picture:
    """By proposals, asked for `counts` intervals in turn, whatever they were fitted with."""
    sampler.counts = counts
    return sampled(scene, sampler, False, rays)._replace(coarse_evaluations=sum(counts[:-1]) * len(rays))


def marched(scene: Field, sampler: OccupancySampler, early_stop: float, rays: Rays) -> Picture:
    """By marching through a grid, until transmittance is below `early_stop`."""
    sampler.early_stop = early_stop
    return sampled(scene, sampler, False, rays)


def renderers(
    scene: Field, proposals: ProposalSampler, grids: Callable[[int], OccupancySampler], count: int
) -> dict[str, Renderer]:
    """Every sampler with a count, which means such numbers of samples that all make as many evaluations, more or less.

    The shares between levels are the framework's defaults. "even steps" marches with nothing skipped.

    Args:
        proposals: fitted to the scene.
        grids: from a number of steps along the box's diagonal to a filled grid.
    """
    return {
        "uniform": partial(sampled, scene, UniformSampler(4 * count), False),
        "stratified": partial(sampled, scene, UniformSampler(4 * count), True),
        "hierarchical": partial(hierarchical, scene, (count, 2 * count)),
        "proposal": partial(proposed, scene, proposals, (4 * count, 2 * count, count)),
        "even steps": partial(marched, scene, full_grid(8 * count), 0.0),
        "occupancy": partial(marched, scene, grids(8 * count), 0.0),
        "early stop": partial(marched, scene, grids(8 * count), EARLY_STOP),
    }


# -- what samplers learn of a scene -------------------------------------------------------------------------------


def full_grid(num_steps: int) -> OccupancySampler:
    """A grid that skips nothing."""
    return OccupancySampler(BOX, 4, num_steps).eval()


def filled_grid(scene: Field, resolution: int, seed: int, num_steps: int) -> OccupancySampler:
    """A grid that its own updates have filled, for marching in `num_steps` along the box's diagonal."""
    sampler = OccupancySampler(BOX, resolution, num_steps)
    for step in range(GRID_STEPS + 1):
        seed_step(seed, step)
        sampler.update(step, scene.density)
    return sampler.eval()


def fitted_proposals(scene: Field, steps: int, seed: int) -> tuple[ProposalSampler, float]:
    """Proposals that have learnt a scene by their own loss, and the seconds it took."""
    torch.manual_seed(seed)
    sampler = ProposalSampler(BOX, anneal_steps=steps // 2)
    how = ProposalSampler.optimised
    assert how is not None
    assert how.learning_rate is not None
    assert how.betas is not None
    assert how.eps is not None
    optimizer = torch.optim.Adam(sampler.parameters(), how.learning_rate, how.betas, how.eps)
    start = time.perf_counter()
    for step in range(steps):
        seed_step(seed, step)
        sampler.update(step, scene.density)
        rendered = render(scene, sampler, random_rays(FIT_RAYS, stream_seed(seed, step)), True)
        assert rendered.samples is not None
        assert rendered.weights is not None
        if rendered.samples.proposals:
            optimizer.zero_grad()
            interlevel_loss(rendered.samples, rendered.weights).backward()
            optimizer.step()
    return sampler.eval(), time.perf_counter() - start
