"""Points where a field is evaluated, with their size."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, Protocol

import torch
from torch import Tensor

from nerfloom.geometry.rays import Rays, Samples

Footprint = Literal["none", "radius", "gaussian", "frustum"]
"""Size of points that a field needs: none; the radius of the pixel's cone; mean and covariance of the cone's interval;
or the interval itself."""


@dataclass(frozen=True)
class Frustums:
    """N conical frustums: intervals of the cones around rays, or of the cylinders around parallel rays."""

    origins: Tensor
    """(N, 3) apex of each cone, or origin of the ray in each cylinder, scene coordinates."""
    directions: Tensor
    """(N, 3) unit direction of each cone's axis."""
    t_starts: Tensor
    """(N,) distance from the origin where the frustum starts."""
    t_ends: Tensor
    """(N,) distance from the origin where the frustum ends."""
    radii: Tensor
    """(N,) radius of the cone at distance 1, or of the cylinder."""
    ranks: Tensor | None = None
    """(N,) number of intervals in front of each on its ray, if known."""
    parallel: bool = False
    """Whether they are cylinders."""

    def __len__(self) -> int:
        return self.t_starts.shape[0]


@dataclass(frozen=True)
class Points:
    """N points where a field is evaluated."""

    positions: Tensor
    """(N, 3) scene coordinates, or (N, 4) points of an inverted sphere (`nerfloom.geometry.spheres`)."""
    times: Tensor | None = None
    """(N,) times in [0, 1]; None for a static scene."""
    radii: Tensor | None = None
    """(N,) radius of the pixel's cone at each point, scene units; None if not computed."""
    covariances: Tensor | None = None
    """(N, 3) diagonal of the covariance of the cone's interval, squared scene units; None if not computed."""
    axes: Tensor | None = None
    """(N, 3) unit direction of the cone's axis; None if not computed."""
    variances: Tensor | None = None
    """(N, 2) variance along the axis and across it, squared scene units; None if not computed."""
    frustums: Frustums | None = None
    """The cones' intervals; None if not computed."""
    ambient: Tensor | None = None
    """(N, K) further coordinates in addition to space, inputs of density and colour; None if there are none."""

    def __len__(self) -> int:
        return self.positions.shape[0]

    def roots(self) -> Tensor:
        """Return roots F (N, 3, 3) of the whole covariances F F^T: columns along the axis and across it.

        Raises:
            ValueError: if the points have no Gaussians.
        """
        if self.axes is None or self.variances is None:
            raise ValueError("these points have no Gaussians: sample_points() computes them for footprint 'gaussian'")
        deviations = self.variances.clamp(min=torch.finfo(self.variances.dtype).tiny).sqrt()  # has a gradient at 0
        # Indexing by a list would copy the list from the CPU.
        return frames(self.axes) * torch.cat([deviations, deviations[:, 1:]], dim=-1)[:, None]

    def sized(self, deviation: float) -> Points:
        """Return points with Gaussians; points without become balls of a standard `deviation`, scene units."""
        if self.variances is not None:
            return self
        axes = torch.zeros_like(self.positions)
        axes[:, 2] = 1
        variances = self.positions.new_full((len(self), 2), deviation**2)
        covariances = self.positions.new_full((len(self), 3), deviation**2)
        return replace(self, axes=axes, variances=variances, covariances=covariances)


class Intervals(Protocol):
    """N intervals along rays, such as `Samples` or the `Wave` of a march."""

    @property
    def t_starts(self) -> Tensor:
        """(N,) distance at the start of each interval."""

    @property
    def t_ends(self) -> Tensor:
        """(N,) distance at the end of each interval."""

    @property
    def t(self) -> Tensor:
        """(N,) distance where the field is evaluated."""


def sample_points(rays: Rays, samples: Samples, footprint: Footprint = "none") -> Points:
    """Return the points where a field is evaluated for samples.

    Args:
        rays: R rays; with `pixel_radii` if a footprint is computed.
        samples: N samples along the rays.
        footprint: kind of the points' size to compute.

    Raises:
        ValueError: if a footprint is to be computed and the rays have no `pixel_radii`.
    """
    ranks = samples.ranks if footprint == "frustum" else None
    return interval_points(rays, samples.ray_indices, samples, None, footprint, ranks)


def interval_points(
    rays: Rays,
    owners: Tensor,
    intervals: Intervals,
    positions: Tensor | None,
    footprint: Footprint,
    ranks: Tensor | None = None,
) -> Points:
    """Return the points where a field is evaluated for intervals.

    Args:
        rays: R rays; with `pixel_radii` if a footprint is computed.
        owners: (N,) int64 index of the ray of each interval.
        intervals: N intervals along the rays.
        positions: (N, 3) positions of the points, if known; not used for Gaussians, whose positions are their means.
        footprint: kind of the points' size to compute.
        ranks: (N,) number of intervals in front of each on its ray, for frustums; None if unknown.

    Raises:
        ValueError: if a footprint is to be computed and the rays have no `pixel_radii`.
    """
    times = None if rays.times is None else rays.times[owners]
    if footprint == "none":
        return Points(rays.points(owners, intervals.t) if positions is None else positions, times)
    if rays.pixel_radii is None:
        raise ValueError("this field uses the size of its points: the rays need pixel_radii")
    radii = rays.pixel_radii.index_select(0, owners)
    if footprint == "radius":
        points = rays.points(owners, intervals.t) if positions is None else positions
        return Points(points, times, radii_at(intervals.t, radii, rays.parallel))
    if footprint == "frustum":
        origins, directions = (x.index_select(0, owners) for x in (rays.origins, rays.directions))
        if positions is None:
            positions = torch.addcmul(origins, directions, intervals.t[:, None])
        frustums = Frustums(origins, directions, intervals.t_starts, intervals.t_ends, radii, ranks, rays.parallel)
        return Points(positions, times, radii_at(intervals.t, radii, rays.parallel), frustums=frustums)
    mean_t, along, across = conical_frustums(intervals.t_starts, intervals.t_ends, radii, rays.parallel)
    axes = rays.directions.index_select(0, owners)
    squared = axes.square()
    covariances = along[:, None] * squared + across[:, None] * (1 - squared)
    variances = torch.stack([along, across], dim=-1)
    return Points(
        rays.points(owners, mean_t), times, radii_at(mean_t, radii, rays.parallel), covariances, axes, variances
    )


def radii_at(t: Tensor, radii: Tensor, parallel: bool) -> Tensor:
    """Return the radius (N,) of pixels at distances `t` (N,) along rays.

    Args:
        t: distances.
        radii: (N,) `Rays.pixel_radii` of the rays.
        parallel: `Rays.parallel`.
    """
    return radii if parallel else t * radii


def conical_frustums(
    t_starts: Tensor, t_ends: Tensor, radii: Tensor, parallel: bool = False
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the Gaussians of conical frustums: Mip-NeRF (Barron et al. 2021), equation 7, in its stable form.

    Args:
        t_starts: (N,) distance where each frustum starts.
        t_ends: (N,) distance where each frustum ends.
        radii: (N,) radius of the cone at distance 1, or of the cylinder.
        parallel: whether they are cylinders.

    Returns:
        (N,) mean distance, (N,) variance along the ray, and (N,) variance perpendicular to the ray.
    """
    middle, half = (t_starts + t_ends) / 2, (t_ends - t_starts) / 2
    if parallel:
        return middle, half.square() / 3, radii.square() / 4
    # Written in half / middle, which is at most 1: half^4 overflows for the last interval, which is very long.
    positive = middle > 0
    squared = torch.where(positive, half / torch.where(positive, middle, torch.ones_like(middle)), 0.0).square()
    total = 3 + squared
    mean_t = middle * (1 + 2 * squared / total)
    along = half.square() * (1 / 3 - (4 / 15) * squared * (12 - squared) / total.square())
    across = (radii * middle).square() * (1 / 4 + (5 / 12) * squared - (4 / 15) * squared.square() / total)
    return mean_t, along, across


def frames(axes: Tensor) -> Tensor:
    """Return rotations (N, 3, 3) with the unit vectors `axes` (N, 3) as their first columns.

    Duff et al. 2017, "Building an orthonormal basis, revisited": the other columns are exact to rounding for all axes,
    without square roots.
    """
    x, y, z = axes.unbind(-1)
    sign = torch.where(z < 0, -1.0, 1.0).to(axes)
    a = -1 / (sign + z)
    b = x * y * a
    first = torch.stack([1 + sign * x * x * a, sign * b, -sign * x], dim=-1)
    second = torch.stack([b, sign + y * y * a, -y], dim=-1)
    return torch.stack([axes, first, second], dim=-1)
