"""Points at which a field is asked, and how large they are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import torch
from torch import Tensor

from framework.geometry.rays import Rays, Samples

Footprint = Literal["none", "radius", "gaussian"]
"""What a field wants to know of a point's size: nothing, the cone's radius there, or the cone's mean and covariance."""


@dataclass(frozen=True)
class Points:
    """N points in space, at which density is asked for."""

    positions: Tensor
    """(N, 3) scene coordinates."""
    times: Tensor | None = None
    """(N,) in [0, 1] of a moving scene; None for a scene that stands still."""
    radii: Tensor | None = None
    """(N,) radius of the pixel's cone at each point, scene units; None where unknown."""
    covariances: Tensor | None = None
    """(N, 3) diagonal of the covariance of the cone's interval, squared scene units; None where unknown."""

    def __len__(self) -> int:
        return self.positions.shape[0]


class Intervals(Protocol):
    """Intervals along rays, as `Samples` are, and as a march hands them out."""

    @property
    def t_starts(self) -> Tensor:
        """(N,) where they start."""

    @property
    def t_ends(self) -> Tensor:
        """(N,) where they end."""

    @property
    def t(self) -> Tensor:
        """(N,) where the field is asked."""


def sample_points(rays: Rays, samples: Samples, footprint: Footprint = "none") -> Points:
    """Return the points at which a field is asked for N samples of R rays.

    Args:
        rays: the rays; a footprint needs their `pixel_radii`.
        samples: intervals along them.
        footprint: how much of the points' size is computed.
    Raises: ValueError where a footprint is wanted and the rays have no radius.
    """
    return interval_points(rays, samples.ray_indices, samples, samples.positions(rays), footprint)


def interval_points(
    rays: Rays, owners: Tensor, intervals: Intervals, positions: Tensor, footprint: Footprint
) -> Points:
    """Return the points at which a field is asked for N intervals of R rays.

    Args:
        rays: the rays; a footprint needs their `pixel_radii`.
        owners: (N,) int64, the ray of each interval.
        intervals: N intervals.
        positions: (N, 3) where the field is asked, but for Gaussians, which have a mean of their own.
        footprint: how much of the points' size is computed.
    Raises: ValueError where a footprint is wanted and the rays have no radius.
    """
    times = None if rays.times is None else rays.times[owners]
    if footprint == "none":
        return Points(positions, times)
    if rays.pixel_radii is None:
        raise ValueError("this field wants to know the size of its points: the rays need pixel_radii")
    radii = rays.pixel_radii.index_select(0, owners)
    if footprint == "radius":
        return Points(positions, times, intervals.t * radii)
    mean_t, along, across = conical_frustums(intervals.t_starts, intervals.t_ends, radii)
    squared = rays.directions.index_select(0, owners).square()
    covariances = along[:, None] * squared + across[:, None] * (1 - squared)
    return Points(rays.points(owners, mean_t), times, mean_t * radii, covariances)


def conical_frustums(t_starts: Tensor, t_ends: Tensor, radii: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the Gaussians of conical frustums: Mip-NeRF (Barron et al. 2021), equation 7, in its stable form.

    Args:
        t_starts, t_ends: (N,) distances between which each frustum lies.
        radii: (N,) radius of the cone at distance 1.
    Returns: (N,) mean distance, variance along the ray, and variance across it.
    """
    middle, half = (t_starts + t_ends) / 2, (t_ends - t_starts) / 2
    # In the share that half is of the middle, which is at most 1: half^4 overflows where an interval has no end.
    there = middle > 0
    squared = torch.where(there, half / torch.where(there, middle, torch.ones_like(middle)), 0.0).square()
    total = 3 + squared
    mean_t = middle * (1 + 2 * squared / total)
    along = half.square() * (1 / 3 - (4 / 15) * squared * (12 - squared) / total.square())
    across = (radii * middle).square() * (1 / 4 + (5 / 12) * squared - (4 / 15) * squared.square() / total)
    return mean_t, along, across
