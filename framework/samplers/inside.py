"""Sampling of the part of rays inside a sphere; the background covers the outside."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from nerfloom.base.step_kind import StepKind
from nerfloom.data.scene import Scene
from nerfloom.fields.base import DensityFunction, Field
from nerfloom.geometry.rays import Rays, Samples
from nerfloom.geometry.spheres import intersect_sphere
from nerfloom.samplers.background import BackgroundConfig, foreground, foreground_sphere
from nerfloom.samplers.base import Sampler
from nerfloom.samplers.choice import make_sampler


class InsideSphere(Sampler):
    """Samples of another sampler, clipped where rays leave a sphere.

    Args:
        sampler: chooses the samples between the near and the far end of each ray.
        sphere: (4,) centre and radius, scene units.
    """

    sphere: Tensor

    def __init__(self, sampler: Sampler, sphere: Tensor) -> None:
        super().__init__()
        self.sampler, self.samples_per_step = sampler, sampler.samples_per_step
        self.has_coarse_level, self.learns_from_weights = sampler.has_coarse_level, sampler.learns_from_weights
        self.register_buffer("sphere", sphere.clone())

    def sample(self, rays: Rays, field: Field, jitter: bool) -> Samples:
        enter, leave = intersect_sphere(rays.origins.detach(), rays.directions.detach(), self.sphere)
        nears = torch.maximum(rays.nears, enter)
        fars = torch.maximum(torch.minimum(rays.fars, leave), nears)
        samples = clipped(self.sampler.sample(replace(rays, nears=nears, fars=fars), field, jitter), nears, fars)
        if samples.coarse is None:
            return samples
        coarse = replace(samples.coarse, samples=clipped(samples.coarse.samples, nears, fars))
        return replace(samples, coarse=coarse)

    def update(self, step: int, density: DensityFunction) -> None:
        """Update the other sampler."""
        self.sampler.update(step, density)

    def step_kind(self, step: int) -> StepKind:
        return self.sampler.step_kind(step)

    def read_counts(self) -> None:
        self.sampler.read_counts()

    def loss(self, samples: Samples, weights: Tensor) -> Tensor | None:
        return self.sampler.loss(samples, weights)


def make_foreground_sampler(
    config: BackgroundConfig, scene: Scene, make_coarse: Callable[[], Field | None] | None = None
) -> Sampler:
    """Return the sampler that the settings select, for the scene's foreground.

    Args:
        scene: properties of the whole scene, not of its foreground.
        make_coarse: creates the coarse field of `--sampler hierarchical`, as in `make_sampler`.
    """
    return inside_foreground(config, scene, make_sampler(config, foreground(config, scene), make_coarse))


def inside_foreground(config: BackgroundConfig, scene: Scene, sampler: Sampler) -> Sampler:
    """Return a sampler of the scene's foreground, clipped to the sphere if the settings have one.

    Args:
        scene: properties of the whole scene, not of its foreground.
        sampler: chooses samples in the box of the foreground.
    """
    if config.background_model != "sphere":
        return sampler
    return InsideSphere(sampler, foreground_sphere(config, scene))


def clipped(samples: Samples, nears: Tensor, fars: Tensor) -> Samples:
    """Return samples whose intervals lie between two distances.

    Samplers may make the last interval of a ray endless, or march from slightly before the near end to slightly beyond.

    Args:
        samples: N samples of R rays.
        nears, fars: (R,) distances.
    """
    near, far = (ends.index_select(0, samples.ray_indices) for ends in (nears, fars))
    starts, ends = (torch.minimum(torch.maximum(t, near), far) for t in (samples.t_starts, samples.t_ends))
    return replace(samples, t_starts=starts, t_ends=ends, points=samples.t)
