"""What a ray is, and what a sample on a ray is.

Letters used everywhere: R rays, N samples (of all rays together), S samples on one ray, t distance along a
ray in scene units, sigma density in 1/length, T transmittance, w weight.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cached_property

import torch
from torch import Tensor


@dataclass(frozen=True)
class Rays:
    """A batch of R rays. Every field is indexed by ray; optional fields are None where unknown."""

    origins: Tensor
    """(R, 3) start points, scene units."""
    directions: Tensor
    """(R, 3) unit directions."""
    nears: Tensor = None  # type: ignore[assignment]
    """(R,) distance at which sampling starts; 0 if not given."""
    fars: Tensor = None  # type: ignore[assignment]
    """(R,) distance at which sampling ends; if not given infinite, for samplers that end with a box."""
    pixel_radii: Tensor | None = None
    """(R,) radius of the pixel's cone at distance 1 (Mip-NeRF, section 3.1)."""
    times: Tensor | None = None
    """(R,) time in [0, 1] of a moving scene."""
    camera_indices: Tensor | None = None
    """(R,) which training camera the ray belongs to."""

    def __post_init__(self) -> None:
        for name, value in (("nears", 0.0), ("fars", torch.inf)):
            if getattr(self, name) is None:
                object.__setattr__(self, name, self.origins.new_full(self.origins.shape[:1], value))

    def __len__(self) -> int:
        return self.origins.shape[0]

    def __getitem__(self, index: Tensor | slice) -> Rays:
        """The rays chosen by a slice, a mask or an index tensor."""
        return self._map(lambda values: values[index])

    def to(self, device: torch.device | str) -> Rays:
        """The same rays on `device`."""
        return self._map(lambda values: values.to(device))

    def _map(self, change: Callable[[Tensor], Tensor]) -> Rays:
        """The same rays with every field that is known changed."""
        known = {f.name: getattr(self, f.name) for f in fields(self)}
        return replace(self, **{name: change(values) for name, values in known.items() if values is not None})

    def points(self, ray_indices: Tensor, t: Tensor) -> Tensor:
        """Positions (N, 3) at distances `t` (N,) along the rays `ray_indices` (N,)."""
        origins = self.origins.index_select(0, ray_indices)
        return torch.addcmul(origins, self.directions.index_select(0, ray_indices), t[:, None])


@dataclass(frozen=True)
class Histogram:
    """What a proposal believed of R rays: B intervals each, and how much of the light each stops."""

    edges: Tensor
    """(R, B + 1) sorted, in a proposal sampler's normalised distance: 0 at the near and 1 at the far end."""
    weights: Tensor
    """(R, B)."""


@dataclass(frozen=True)
class Samples:
    """Packed intervals along R rays: ray r owns the samples [offsets[r], offsets[r + 1]), near to far.

    One layout serves every sampler: an empty ray costs nothing, and a sampler that puts S samples on each
    ray sets `per_ray`, so that `padded` may view its values as (R, S).

    A sampler that has to know the density in order to sample (waves that stop where transmittance is spent)
    hands over what it evaluated in `sigma` and `features`, gradients attached, so nothing is evaluated twice.
    """

    t_starts: Tensor
    """(N,) distance where each interval starts."""
    t_ends: Tensor
    """(N,) distance where each interval ends."""
    offsets: Tensor
    """(R + 1,) int64 start of each ray's samples; the last entry is N."""
    points: Tensor | None = None
    """(N,) distance at which the field is evaluated; the middle of the interval if None."""
    per_ray: int | None = None
    """S if every ray has exactly S samples."""
    owners: Tensor | None = None
    """(N,) `ray_indices`, where they are known already."""
    sigma: Tensor | None = None
    """(N,) density, where the sampler already evaluated it."""
    features: Tensor | None = None
    """(N, F) the field's features that came with `sigma`."""
    edges: Tensor | None = None
    """(R, S + 1) the intervals' ends in normalised distance, from a sampler that works in it."""
    proposals: tuple[Histogram, ...] = ()
    """What these were drawn by, where it is still being learnt: gradients attached."""

    @classmethod
    def regular(cls, t_starts: Tensor, t_ends: Tensor, points: Tensor | None = None) -> Samples:
        """S samples on each of R rays, from (R, S) tensors."""
        num_rays, per_ray = t_starts.shape
        offsets = torch.arange(num_rays + 1, device=t_starts.device) * per_ray
        flat = None if points is None else points.reshape(-1)
        return cls(t_starts.reshape(-1), t_ends.reshape(-1), offsets, flat, per_ray)

    def __len__(self) -> int:
        return self.t_starts.shape[0]

    @property
    def num_rays(self) -> int:
        """R."""
        return self.offsets.shape[0] - 1

    @property
    def counts(self) -> Tensor:
        """(R,) number of samples on each ray."""
        return self.offsets[1:] - self.offsets[:-1]

    @cached_property
    def ray_indices(self) -> Tensor:
        """(N,) the ray that owns each sample."""
        if self.owners is not None:
            return self.owners
        rays = torch.arange(self.num_rays, device=self.offsets.device)
        return torch.repeat_interleave(rays, self.counts, output_size=len(self))

    @cached_property
    def places(self) -> Tensor:
        """(N,) how many samples stand in front of each on its ray."""
        return torch.arange(len(self), device=self.offsets.device) - self.offsets[:-1][self.ray_indices]

    @property
    def t(self) -> Tensor:
        """(N,) distance at which the field is evaluated."""
        return (self.t_starts + self.t_ends) / 2 if self.points is None else self.points

    @property
    def deltas(self) -> Tensor:
        """(N,) length of each interval."""
        return self.t_ends - self.t_starts

    def padded(self, values: Tensor) -> Tensor:
        """View per-sample `values` (N, ...) as (R, S, ...).

        Raises: ValueError where the rays have different numbers of samples.
        """
        if self.per_ray is None:
            raise ValueError("padded() needs the same number of samples on every ray")
        return values.reshape(self.num_rays, self.per_ray, *values.shape[1:])

    def positions(self, rays: Rays) -> Tensor:
        """(N, 3) where the field is evaluated."""
        return rays.points(self.ray_indices, self.t)

    def times(self, rays: Rays) -> Tensor | None:
        """(N,) time of each sample, or None for a scene that stands still."""
        return None if rays.times is None else rays.times[self.ray_indices]

    def evaluated(self, sigma: Tensor, features: Tensor) -> Samples:
        """The same samples with their density (N,) and features (N, F) attached."""
        return replace(self, sigma=sigma, features=features)
