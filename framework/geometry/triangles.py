"""Triangles: their areas and normals, points drawn on them evenly by area, and their nearest points.

A point of a triangle is given by its barycentric weights (3,): non-negative, with sum 1.
"""

from __future__ import annotations

import torch
from torch import Tensor


def area_vectors(corners: Tensor) -> Tensor:
    """Return vectors (F, 3) normal to triangles of `corners` (F, 3, 3), as long as twice their areas.

    Triangles are counterclockwise seen from the vectors' tips.
    """
    a, b, c = corners.unbind(1)
    return torch.linalg.cross(b - a, c - a)


def draw_on_triangles(corners: Tensor, count: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Draw points on triangles, evenly by area.

    The area is divided into `count` equal parts, in the order of the triangles, with a point in each. So a triangle's
    number of points differs from its share by less than two. The same seed gives the same points.

    Args:
        corners: (F, 3, 3) float64 corners of triangles with a positive total area.
        count: number of points.
        seed: seed of the points.

    Returns:
        (count,) int64 triangle of each point, and its barycentric weights (count, 3).
    """
    ends = area_vectors(corners).norm(dim=-1).cumsum(0)
    random = torch.rand(3, count, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    places = (torch.arange(count) + random[0]) / count * ends[-1]
    faces = torch.searchsorted(ends, places, right=True).clamp(max=len(ends) - 1)
    # The square root makes the density of distances from the first corner proportional to the triangle's width there.
    away = random[1].sqrt()
    return faces, torch.stack([1 - away, away * (1 - random[2]), away * random[2]], dim=-1)


def nearest_on_triangles(points: Tensor, corners: Tensor) -> tuple[Tensor, Tensor]:
    """Return the point of each triangle that is nearest to a given point.

    It is the projection onto the triangle's plane if that is inside the triangle, and otherwise on an edge.

    Args:
        points: (N, 3) positions, one for each triangle.
        corners: (N, 3, 3) corners; a triangle without area counts as its edges.

    Returns:
        The barycentric weights (N, 3) of the nearest points, and their distances (N,).
    """
    a, b, c = corners.unbind(1)
    candidates = [_weights_in_plane(points - a, b - a, c - a)]
    for start, end in ((0, 1), (1, 2), (2, 0)):
        along = corners[:, end] - corners[:, start]
        squared = along.square().sum(-1).clamp(min=torch.finfo(points.dtype).tiny)
        share = (((points - corners[:, start]) * along).sum(-1) / squared).clamp(0, 1)
        weights = torch.zeros_like(points)
        weights[:, start], weights[:, end] = 1 - share, share
        candidates.append(weights)
    weights = torch.stack(candidates, dim=1)
    distances = (points[:, None] - weights @ corners).norm(dim=-1)
    shortest, chosen = distances.nan_to_num(nan=torch.inf).min(-1)
    return weights[torch.arange(len(points)), chosen], shortest


def _weights_in_plane(p: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Return the weights (N, 3) of projections onto the plane of edges `u` and `v`; NaN outside of the triangle.

    Args:
        p: (N, 3) points relative to the corner where the edges (N, 3) start.
    """
    uu, uv, vv, pu, pv = ((x * y).sum(-1) for x, y in ((u, u), (u, v), (v, v), (p, u), (p, v)))
    determinant = uu * vv - uv * uv
    second, third = (vv * pu - uv * pv) / determinant, (uu * pv - uv * pu) / determinant
    weights = torch.stack([1 - second - third, second, third], dim=-1)
    return weights.where((weights >= 0).all(-1, keepdim=True), torch.nan)
