"""Sampling of the part of rays inside a sphere; the background covers the outside."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from nerfloom.data.scene import Scene
from nerfloom.fields.base import Field
from nerfloom.geometry.rays import Rays, Samples
from nerfloom.geometry.spheres import intersect_sphere
from nerfloom.samplers.background import BackgroundConfig, foreground, foreground_sphere
from nerfloom.samplers.base import Sampler
from nerfloom.samplers.choice import make_sampler
from nerfloom.samplers.wrapping import WrappingSampler


class InsideSphere(WrappingSampler):
    """Samples of `sampler` along rays clipped where they leave a `sphere` (4,), centre and radius, scene units."""

    sphere: Tensor

    def __init__(self, sampler: Sampler, sphere: Tensor) -> None:
        super().__init__(sampler)
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
    """Return `sampler` of the foreground's box, clipped to the sphere if the settings of the `scene` have one."""
    if config.background_model != "sphere":
        return sampler
    return InsideSphere(sampler, foreground_sphere(config, scene))


def clipped(samples: Samples, nears: Tensor, fars: Tensor) -> Samples:
    """Return samples with intervals between two distances.

    Samplers may make the last interval of a ray endless, or march from slightly before the near end to slightly beyond.

    Args:
        samples: N samples of R rays.
        nears, fars: (R,) distances.
    """
    near, far = (ends.index_select(0, samples.ray_indices) for ends in (nears, fars))
    starts, ends = (torch.minimum(torch.maximum(t, near), far) for t in (samples.t_starts, samples.t_ends))
    return replace(samples, t_starts=starts, t_ends=ends, points=samples.t)
