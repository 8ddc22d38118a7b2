"""Spheres: their intersection with rays, and the inverted sphere, where all of space outside has a finite size.

NeRF++ (Zhang et al. 2020), section 4: outside of the unit sphere, the point at distance r from its centre is (x', y',
z', 1/r), where (x', y', z') is its direction from the centre, of length 1. With m the point of a ray that is nearest to
the centre, d its unit direction and s = 1/r, the ray's point beyond m at distance r is m + sqrt(r^2 - |m|^2) d, hence

    (x', y', z') = s m + sqrt(1 - s^2 |m|^2) d

The paper instead rotates the point where the ray leaves the unit sphere by the angle asin |m| - asin (s |m|). The
result is the same point, but the rotation has no axis if the ray passes through the centre. The formula here has no
division, and at s = 0 it gives the direction of the ray.

A sphere is a tensor (4,): its centre and its radius, scene units.
"""

from __future__ import annotations

from dataclasses import fields

import torch
from torch import Tensor

from nerfloom.geometry.rays import Rays


def nearest_to_centre(origins: Tensor, directions: Tensor, sphere: Tensor) -> tuple[Tensor, Tensor]:
    """Return where rays, continued to both sides, are nearest to the centre of a sphere.

    Args:
        origins, directions: (R, 3).
        sphere: (4,) centre and radius.

    Returns:
        (R,) distances along the rays, scene units, negative behind the origin; and (R, 3) positions relative to the
        centre, in units of the radius.
    """
    offsets = origins - sphere[:3]
    middles = -(offsets * directions).sum(-1)
    return middles, torch.addcmul(offsets, directions, middles[:, None]) / sphere[3]


def intersect_sphere(origins: Tensor, directions: Tensor, sphere: Tensor) -> tuple[Tensor, Tensor]:
    """Return the distances where rays enter and leave a sphere.

    A ray that starts inside enters at 0. For a ray that misses the sphere, only touches it, or leaves it behind, both
    distances are 0: an interval of length 0.

    Args:
        origins, directions: (R, 3).
        sphere: (4,) centre and radius.

    Returns:
        enter (R,) and leave (R,), with 0 <= enter <= leave.
    """
    middles, nearest = nearest_to_centre(origins, directions, sphere)
    square = 1 - nearest.square().sum(-1)
    hit = square > 0
    half = sphere[3] * torch.where(hit, square, torch.ones_like(square)).sqrt()
    zero = torch.zeros_like(half)
    enter, leave = (torch.where(hit, middles + side, zero).clamp(min=0) for side in (-half, half))
    return enter, leave


class InvertedRays(Rays):
    """The parts of rays behind a sphere, parameterised by u = 1 - 1/r instead of the distance along the ray.

    `origins` are the points nearest to the centre, in units of the sphere's radius; `nears` and `fars` are values of u,
    0 on the sphere and 1 at infinity; `points` returns (N, 4) points (x', y', z', 1/r) of the inverted sphere.

    If a ray enters the sphere, its part behind starts where the ray leaves it. If a ray misses the sphere, the part
    starts where the ray is nearest to the centre, since 1/r falls from there on. Anything before that is not shown, so
    a camera far outside the sphere sees through it.
    """

    @classmethod
    def of(cls, rays: Rays, sphere: Tensor) -> InvertedRays:
        """Return the part of R `rays` behind a `sphere` (4,), centre and radius; of length 0 if they end earlier."""
        middles, nearest = nearest_to_centre(rays.origins, rays.directions, sphere)
        with torch.no_grad():  # the ends of intervals have no gradient
            _, leave = intersect_sphere(rays.origins, rays.directions, sphere)
            start = torch.maximum(torch.maximum(leave, middles), rays.nears)
            missed = nearest.norm(dim=-1)
            nears, fars = (
                1 - 1 / torch.hypot((t - middles) / sphere[3], missed).clamp(min=1)
                for t in (start, torch.maximum(rays.fars, start))
            )
        values = {field.name: getattr(rays, field.name) for field in fields(Rays)}
        return cls(**{**values, "origins": nearest, "nears": nears, "fars": fars})

    def points(self, ray_indices: Tensor, t: Tensor) -> Tensor:
        """Return points (N, 4), unit direction and 1/r, of rays `ray_indices` (N,) at `t` (N,), u = 1 - 1/r."""
        nearest, inverse = self.origins.index_select(0, ray_indices), 1 - t
        square = 1 - inverse.square() * nearest.square().sum(-1)
        # Clamped: for a ray that misses the sphere this is 0 at the start, where the root has an infinite gradient.
        along = square.clamp(min=torch.finfo(square.dtype).eps).sqrt()
        directions = self.directions.index_select(0, ray_indices)
        return torch.cat([inverse[:, None] * nearest + along[:, None] * directions, inverse[:, None]], dim=-1)


def distances_behind(u: Tensor, rays: Rays, sphere: Tensor) -> Tensor:
    """Return the distances (R,) along rays of points outside a sphere, scene units, at most the rays' far ends.

    Args:
        u: (R,) values of 1 - 1/r.
        rays: the rays themselves.
        sphere: (4,) centre and radius.
    """
    middles, nearest = nearest_to_centre(rays.origins, rays.directions, sphere)
    radii = 1 / (1 - u).clamp(min=torch.finfo(u.dtype).tiny)
    along = (radii.square() - nearest.square().sum(-1)).clamp(min=0).sqrt()
    return torch.minimum(middles + sphere[3] * along, rays.fars)
