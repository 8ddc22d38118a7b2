"""Rendering of scenes with every sampler of the framework, counting evaluations of the field.

All evaluations are counted, including those with unused results. Evaluations of a coarse field or of proposals are
counted separately, because proposals are much smaller than the field.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

from benchmarks.closed_forms import BOX
from nerfloom.base.device import seed_step, stream_seed
from nerfloom.fields.base import Field
from nerfloom.geometry.points import Points
from nerfloom.geometry.rays import Rays
from nerfloom.rendering.rendered import Rendered
from nerfloom.rendering.volume import VolumeRenderer
from nerfloom.samplers.base import Sampler
from nerfloom.samplers.hierarchical import HierarchicalSampler
from nerfloom.samplers.occupancy import OccupancySampler
from nerfloom.samplers.proposal import ProposalSampler, interlevel_loss
from nerfloom.samplers.uniform import UniformSampler

WHITE = torch.ones(3)
"""(3,) background."""
DISTANCE, NEAR, FAR = 4.0, 2.0, 6.0
"""Distance of ray origins from the scene's centre, and near and far ends, as in NeRF's synthetic scenes."""
EARLY_STOP = 1e-4
"""The sampler "early stop" ends rays at this transmittance, the default in rendering."""
GRID_STEPS = 1024
"""Training steps for filling an occupancy grid, four times its warm-up."""
FIT_RAYS = 1024
"""Rays per step of training proposals."""


def random_rays(count: int, seed: int) -> Rays:
    """Return `count` random rays by `seed`, from all sides to positions uniform in the largest ball in the box."""
    generator = torch.Generator().manual_seed(seed)
    origins, outwards = (normalize(torch.randn(count, 3, generator=generator), dim=-1) for _ in range(2))
    origins, targets = DISTANCE * origins, outwards * torch.rand(count, 1, generator=generator) ** (1 / 3)
    ends = torch.full((count,), NEAR), torch.full((count,), FAR)
    return Rays(origins, normalize(targets - origins, dim=-1), *ends)


# -- rendering ----------------------------------------------------------------------------------------------------


class Picture(NamedTuple):
    """Colours of R rays and the evaluations they took."""

    color: Tensor
    """(R, 3) colours."""
    evaluations: int
    """Number of evaluations of the field."""
    coarse_evaluations: int
    """Number of evaluations of a coarse field or of proposals."""


Renderer = Callable[[Rays], Picture]
"""Function that renders rays."""


class Counted(Field):
    """A `field` that counts the evaluations of its density."""

    def __init__(self, field: Field) -> None:
        super().__init__()
        self.field, self.count = field, 0

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        self.count += len(points)
        return self.field.density(points)

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        return self.field.color(features, directions, camera_indices)


def render(field: Field, sampler: Sampler, rays: Rays, jitter: bool) -> Rendered:
    """Render a `field` over white along R `rays`, with samples of a `sampler`, at random positions if `jitter`."""
    return VolumeRenderer().render(rays, sampler.sample(rays, field, jitter), field, WHITE)


def sampled(scene: Field, sampler: Sampler, jitter: bool, rays: Rays) -> Picture:
    """Render a `scene` with a `sampler` that evaluates only the field; `jitter` and `rays` are as in `render`."""
    field = Counted(scene)
    return Picture(render(field, sampler, rays, jitter).rgb, field.count, 0)


def hierarchical(scene: Field, counts: tuple[int, int], rays: Rays) -> Picture:
    """Render a `scene` along `rays` with hierarchical sampling, using the field also as the coarse field.

    `counts` are samples per ray of the coarse field, and further samples of the fine field.
    """
    coarse, fine = Counted(scene), Counted(scene)
    sampler = HierarchicalSampler(coarse, *counts)
    return Picture(render(fine, sampler, rays, False).rgb, fine.count, coarse.count)


def proposed(scene: Field, sampler: ProposalSampler, counts: tuple[int, ...], rays: Rays) -> Picture:
    """Render a `scene` along `rays` with the proposals of a `sampler`, trained on the scene.

    `counts` are intervals per ray of each proposal and of the field, independent of the proposals' training.
    """
    sampler.counts = counts
    return sampled(scene, sampler, False, rays)._replace(coarse_evaluations=sum(counts[:-1]) * len(rays))


def marched(scene: Field, sampler: OccupancySampler, early_stop: float, rays: Rays) -> Picture:
    """Render a `scene` by marching `rays` through the filled grid of a `sampler`, to the transmittance `early_stop`."""
    sampler.early_stop = early_stop
    return sampled(scene, sampler, False, rays)


def renderers(
    scene: Field, proposals: ProposalSampler, grids: Callable[[int], OccupancySampler], count: int
) -> dict[str, Renderer]:
    """Return a renderer for each sampler, by name, all with about the same number of evaluations.

    The ratios between levels are the framework's defaults. "even steps" marches without skipping.

    Args:
        scene: the scene.
        proposals: proposals trained on the scene.
        grids: function from the number of steps along the box's diagonal to a filled grid.
        count: unit of the numbers of samples, steps and intervals.
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


# -- fitting samplers to a scene -----------------------------------------------------------------------------------


def full_grid(num_steps: int) -> OccupancySampler:
    """Return a grid that skips nothing, for marching in `num_steps` along the box's diagonal."""
    return OccupancySampler(BOX, 4, num_steps).eval()


def filled_grid(scene: Field, resolution: int, seed: int, num_steps: int) -> OccupancySampler:
    """Return a grid for marches in `num_steps`, of `resolution` cells per axis, filled by its updates with a `scene`.

    Updates are random, by `seed`.
    """
    sampler = OccupancySampler(BOX, resolution, num_steps)
    for step in range(GRID_STEPS + 1):
        seed_step(seed, step)
        sampler.update(step, scene.density)
    return sampler.eval()


def fitted_proposals(scene: Field, steps: int, seed: int) -> tuple[ProposalSampler, float]:
    """Train proposals on a `scene` with their own loss for some `steps`, with a random `seed`.

    Returns:
        The proposals, and the seconds of training.
    """
    torch.manual_seed(seed)
    sampler = ProposalSampler(BOX, anneal_steps=steps // 2)
    settings = ProposalSampler.optimised
    assert settings is not None
    assert settings.learning_rate is not None
    assert settings.betas is not None
    assert settings.eps is not None
    optimizer = torch.optim.Adam(sampler.parameters(), settings.learning_rate, settings.betas, settings.eps)
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
