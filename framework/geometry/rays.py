"""Rays, and samples along them.

Letters used in all modules: R rays, N samples (of all rays together), S samples on one ray, t distance along a ray in
scene units, sigma density in 1/length, T transmittance, w weight.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from nerfloom.geometry.records import TensorRows


@dataclass(frozen=True)
class Rays(TensorRows):
    """A batch of R rays. Every tensor is indexed by ray; optional ones are None if unknown."""

    origins: Tensor
    """(R, 3) origins, scene units."""
    directions: Tensor
    """(R, 3) unit directions."""
    nears: Tensor = None  # type: ignore[assignment]
    """(R,) distance where sampling starts; 0 if not given."""
    fars: Tensor = None  # type: ignore[assignment]
    """(R,) distance where sampling ends; if not given infinite, for samplers that end with a box."""
    pixel_radii: Tensor | None = None
    """(R,) radius of the pixel's cone at distance 1 (Mip-NeRF, section 3.1); at all distances if `parallel`."""
    times: Tensor | None = None
    """(R,) time in [0, 1] of a moving scene."""
    camera_indices: Tensor | None = None
    """(R,) index of the training camera."""
    places: Tensor | None = None
    """(R, 2) position in the camera's image from its left and top edge, 0 to 1 (`Cameras.places`)."""
    parallel: bool = False
    """Whether neighbouring rays are parallel (orthographic cameras), so that pixels are as wide at all distances."""

    def __post_init__(self) -> None:
        for name, value in (("nears", 0.0), ("fars", torch.inf)):
            if getattr(self, name) is None:
                object.__setattr__(self, name, self.origins.new_full(self.origins.shape[:1], value))

    def __len__(self) -> int:
        return self.origins.shape[0]

    def detached(self) -> Rays:
        """Return the rays without a gradient."""
        return self.map(lambda values: values.detach())

    def points(self, ray_indices: Tensor, t: Tensor) -> Tensor:
        """Return positions along rays.

        Args:
            ray_indices: (N,) index of the ray of each position.
            t: (N,) distances along the rays.

        Returns:
            (N, 3) positions.
        """
        origins = self.origins.index_select(0, ray_indices)
        return torch.addcmul(origins, self.directions.index_select(0, ray_indices), t[:, None])


@dataclass(frozen=True)
class Histogram:
    """A proposal's estimate for R rays: B intervals each, with the share of the light that each interval stops."""

    edges: Tensor
    """(R, B + 1) sorted edges in the proposal sampler's normalised distance: 0 at the near end and 1 at the far end."""
    weights: Tensor
    """(R, B) weights of the intervals."""


@dataclass(frozen=True)
class CoarseLevel:
    """The coarse level of hierarchical sampling, which is rendered and supervised too."""

    field: Any
    """The field that was sampled (`nerfloom.Field`)."""
    samples: Samples
    """Its samples on the same rays, with density and features."""


@dataclass(frozen=True)
class Samples:
    """Packed intervals along R rays: ray r owns the samples [offsets[r], offsets[r + 1]), near to far.

    All samplers use this layout: a ray without samples takes no space, and a sampler that puts S samples on each ray
    sets `per_ray`, so that `padded` can view values as (R, S).

    A sampler that evaluates the density in order to sample (in waves that stop when the transmittance is spent) returns
    the results in `sigma` and `features`, gradients attached, so that nothing is evaluated twice.
    """

    t_starts: Tensor
    """(N,) distance at the start of each interval."""
    t_ends: Tensor
    """(N,) distance at the end of each interval."""
    offsets: Tensor
    """(R + 1,) int64 index of each ray's first sample; the last entry is N."""
    points: Tensor | None = None
    """(N,) distance where the field is evaluated; if None, the middle of the interval."""
    per_ray: int | None = None
    """S if every ray has exactly S samples."""
    owners: Tensor | None = None
    """(N,) `ray_indices`, if the sampler has them."""
    longest: int | None = None
    """Upper bound of the number of samples on a ray, if the sampler knows one."""
    filled: Tensor | None = None
    """() int64 number of samples in use; the others have length 0. None if all samples are in use."""
    sigma: Tensor | None = None
    """(N,) density, if the sampler evaluated it."""
    features: Tensor | None = None
    """(N, F) the field's features evaluated together with `sigma`."""
    alpha: Tensor | None = None
    """(N,) opacity of each interval, of a field that has it instead of density."""
    early_stop: float = 0.0
    """Transmittance below which rays were ended: the maximum error of a colour channel. 0 if none were."""
    coarse: CoarseLevel | None = None
    """The coarse level, if it is rendered too; the samples were drawn from its weights."""
    edges: Tensor | None = None
    """(R, S + 1) ends of the intervals in normalised distance, from samplers that use it."""
    proposals: tuple[Histogram, ...] = ()
    """Histograms that the samples were drawn from, gradients attached, if the proposals are being trained."""

    @classmethod
    def regular(cls, t_starts: Tensor, t_ends: Tensor, points: Tensor | None = None) -> Samples:
        """Return samples with the same number S on each of R rays.

        Args:
            t_starts: (R, S) distance at the start of each interval.
            t_ends: (R, S) distance at the end of each interval.
            points: (R, S) distance where the field is evaluated; if None, the middle of the interval.
        """
        num_rays, per_ray = t_starts.shape
        offsets = torch.arange(num_rays + 1, device=t_starts.device) * per_ray
        flat = None if points is None else points.reshape(-1)
        return cls(t_starts.reshape(-1), t_ends.reshape(-1), offsets, flat, per_ray)

    def __len__(self) -> int:
        return self.t_starts.shape[0]

    @property
    def num_evaluated(self) -> int | Tensor:
        """The number of samples that count as evaluated; () int64 if the device alone knows it."""
        return len(self) if self.filled is None else self.filled

    @property
    def num_rays(self) -> int:
        """The number R of rays."""
        return self.offsets.shape[0] - 1

    @property
    def counts(self) -> Tensor:
        """(R,) number of samples on each ray."""
        return self.offsets[1:] - self.offsets[:-1]

    @cached_property
    def ray_indices(self) -> Tensor:
        """(N,) index of the ray of each sample."""
        if self.owners is not None:
            return self.owners
        rays = torch.arange(self.num_rays, device=self.offsets.device)
        return torch.repeat_interleave(rays, self.counts, output_size=len(self))

    @cached_property
    def ranks(self) -> Tensor:
        """(N,) number of samples in front of each sample on its ray."""
        if self.per_ray is not None:
            return torch.arange(self.per_ray, device=self.offsets.device).repeat(self.num_rays)
        return torch.arange(len(self), device=self.offsets.device) - self.offsets[:-1][self.ray_indices]

    @property
    def t(self) -> Tensor:
        """(N,) distance where the field is evaluated."""
        return (self.t_starts + self.t_ends) / 2 if self.points is None else self.points

    @property
    def deltas(self) -> Tensor:
        """(N,) length of each interval."""
        return self.t_ends - self.t_starts

    def padded(self, values: Tensor) -> Tensor:
        """View per-sample `values` (N, ...) as (R, S, ...).

        Raises:
            ValueError: if the rays have different numbers of samples.
        """
        if self.per_ray is None:
            raise ValueError("padded() needs the same number of samples on every ray")
        return values.reshape(self.num_rays, self.per_ray, *values.shape[1:])

    def positions(self, rays: Rays) -> Tensor:
        """Return the positions (N, 3) on `rays` where the field is evaluated."""
        return rays.points(self.ray_indices, self.t)

    def times(self, rays: Rays) -> Tensor | None:
        """Return the time (N,) of each sample on `rays`, or None for a static scene."""
        return None if rays.times is None else rays.times[self.ray_indices]

    def evaluated(self, sigma: Tensor, features: Tensor) -> Samples:
        """Return the samples with density `sigma` (N,) and the field's `features` (N, F) attached."""
        return replace(self, sigma=sigma, features=features)

    def with_alpha(self, alpha: Tensor, features: Tensor) -> Samples:
        """Return the samples with opacity `alpha` (N,) of intervals and the field's `features` (N, F)."""
        return replace(self, alpha=alpha, features=features)
