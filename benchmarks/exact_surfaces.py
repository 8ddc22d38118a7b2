"""Points on an exact surface, given by its signed distance, and whether cameras see them."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

SignedDistance = Callable[[Tensor], Tensor]
"""Function from positions (N, 3) to signed distances (N,), negative inside a solid."""
SHELL = 0.01
"""Half the thickness of the shell where points are drawn, before they are moved to the surface."""
CHUNK = 2**17
"""Number of positions evaluated at once."""


def surface_sample(distance: SignedDistance, box: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return `count` evenly distributed points (count, 3) float64 of a surface, and its outward normals.

    The surface is where `distance` is 0, in a `box` (2, 3).

    Points are drawn in a thin shell around the surface, and moved along the gradient of the distance. The distribution
    is even up to terms of the shell's thickness times the curvature.
    """
    box, points, normals, found = box.double(), [], [], 0
    while found < count:
        drawn = box[0] + torch.rand(CHUNK, 3, dtype=torch.float64) * (box[1] - box[0])
        near = drawn[distance(drawn).abs() < SHELL]
        for _ in range(3):
            near = near - distance(near)[:, None] * _gradient(distance, near)
        points.append(near)
        normals.append(_gradient(distance, near))
        found += len(near)
    return torch.cat(points)[:count], torch.cat(normals)[:count]


def _gradient(distance: SignedDistance, points: Tensor) -> Tensor:
    """Return the unit gradient (N, 3) of a distance by central differences."""
    step = 1e-5
    offsets = step * torch.eye(3, dtype=points.dtype)
    columns = [distance(points + offset) - distance(points - offset) for offset in offsets]
    return torch.nn.functional.normalize(torch.stack(columns, -1), dim=-1)


def visible_from(distance: SignedDistance, points: Tensor, normals: Tensor, cameras: Tensor) -> Tensor:
    """Return whether each point of a surface is visible from any of several positions, (N,) bool, by sphere tracing.

    Fields of view are ignored: each camera sees the whole scene.

    Args:
        distance: the surface.
        points: (N, 3) points on it.
        normals: (N, 3) their outward normals.
        cameras: (M, 3) positions outside the solids.
    """
    seen = torch.zeros(len(points), dtype=torch.bool)
    starts = points + 1e-3 * normals
    for camera in cameras.double():
        left = (~seen).nonzero()[:, 0]
        towards = camera - starts[left]
        left = left[(towards * normals[left]).sum(-1) > 0]
        towards = camera - starts[left]
        length = towards.norm(dim=-1)
        directions = towards / length[:, None]
        t, free = torch.zeros(len(left), dtype=torch.float64), torch.ones(len(left), dtype=torch.bool)
        active = torch.arange(len(left))
        for _ in range(80):
            step = distance(starts[left[active]] + t[active, None] * directions[active])
            free[active[step < 1e-4]] = False
            t[active] += step.clamp(min=1e-4)
            active = active[(step >= 1e-4) & (t[active] < length[active])]
            if not len(active):
                break
        seen[left[free]] = True
    return seen
