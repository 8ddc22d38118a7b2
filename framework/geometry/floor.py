"""The floor of a scene: the plane that most points lie on, and few below.

Planes through three random points are tried (RANSAC, Fischler and Bolles 1981), and the best one is fitted to the
points near it by least squares, in rounds with less and less tolerance.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from nerfloom.base.evenly_spaced import evenly_spaced

TRIALS = 5_000
"""Number of planes that are tried."""
TRIALS_AT_ONCE = 250
"""Number of planes that are compared with the points at once."""
MAX_POINTS = 5_000
"""Maximum number of points that planes are compared with."""
TOLERANCE = 0.01
"""Default tolerance, as a fraction of the median distance of points from their middle."""
MAX_BELOW = 0.1
"""Maximum share of points below a floor: a table top has more."""
ROUNDS = 10
"""Number of least-squares fits."""


class Plane(NamedTuple):
    """A plane, and the points near it."""

    normal: Tensor
    """(3,) float64 unit vector, upwards."""
    center: Tensor
    """(3,) float64 mean of the points near it."""
    share: float
    """Share of the points that the last fit counts."""


def size_of(points: Tensor) -> float:
    """Return the diagonal of the box between the 5th and the 95th percentile along each axis.

    Args:
        points: (N, 3).
    """
    ordered = points.double().sort(0).values
    last = len(points) - 1
    return float((ordered[last - round(0.05 * last)] - ordered[round(0.05 * last)]).norm())


def find_floor(
    points: Tensor,
    up: Tensor,
    max_tilt: float = 45.0,
    tolerance: float | None = None,
    seed: int = 0,
    above: Tensor | None = None,
) -> Plane | None:
    """Find the floor among points; None if there is none. The same arguments give the same plane.

    Args:
        points: (N, 3) positions on surfaces.
        up: (3,) float64 unit vector, about upwards.
        max_tilt: maximum angle between `up` and the floor's normal, degrees.
        tolerance: maximum distance of the floor's points from it; None for 1 % of the median distance of all points
            from their middle. Fits may reduce it.
        seed: seed of the random planes.
        above: (M, 3) positions above the floor, such as the cameras; None for none.
    """
    if len(points) < 3:
        return None
    middle = points.double().median(0).values
    centred = points.double() - middle
    spread = float(centred.norm(dim=-1).median())
    limit = TOLERANCE * spread if tolerance is None else tolerance
    some = centred[evenly_spaced(len(centred), MAX_POINTS)]
    over = centred[:0] if above is None else above.to(centred) - middle
    found = _best(some, over, up, math.cos(math.radians(max_tilt)), limit, seed)
    if found is None:
        return None
    normal, center = found
    near = centred
    for _ in range(ROUNDS):
        near = centred[((centred - center) @ normal).abs() <= limit]
        center = near.mean(0)
        normal = torch.linalg.eigh((near - center).T @ (near - center)).eigenvectors[:, 0]
        normal = normal if float(normal @ up) > 0 else -normal
        error = float(((near - center) @ normal).square().mean().sqrt())
        limit = min(limit, max(3 * error, 1e-9 * spread))
    return Plane(normal, center + middle, len(near) / len(points))


def _best(
    points: Tensor, above: Tensor, up: Tensor, min_cosine: float, tolerance: float, seed: int
) -> tuple[Tensor, Tensor] | None:
    """Return the normal of the best plane through three of the points (N, 3), and a point on it; None without one."""
    generator = torch.Generator().manual_seed(seed)
    first, second, third = points[torch.randint(len(points), (TRIALS, 3), generator=generator)].unbind(1)
    normals = torch.linalg.cross(second - first, third - first)
    lengths = normals.norm(dim=-1, keepdim=True)
    normals = normals / lengths.clamp(min=1e-300)
    normals = torch.where((normals @ up)[:, None] < 0, -normals, normals)
    usable = (lengths[:, 0] > 0) & (normals @ up >= min_cosine)
    normals, first = normals[usable], first[usable]
    counts = [torch.zeros(0, dtype=torch.int64)]
    for start in range(0, len(normals), TRIALS_AT_ONCE):
        part = slice(start, start + TRIALS_AT_ONCE)
        offsets = (first[part] * normals[part]).sum(-1)
        heights = points @ normals[part].T - offsets
        below = (heights < -tolerance).double().mean(0)
        wrong = (below > MAX_BELOW) | (above @ normals[part].T < offsets).any(0)
        counts.append((heights.abs() <= tolerance).sum(0).masked_fill(wrong, 0))
    found = torch.cat(counts)
    if not len(found) or int(found.max()) < 3:
        return None
    best = int(found.argmax())
    return normals[best], first[best]
