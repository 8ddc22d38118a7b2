"""A ball rendered in closed form; its colour depends on the direction of its normal."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from nerfloom.cameras.cameras import Cameras
from nerfloom.evaluation.paths import look_at

RADIUS = 0.7
"""Radius of the ball, scene units."""


def trace(origins: Tensor, unit_directions: Tensor, centers: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Intersect rays with the surface of a ball; a ray that starts inside meets it on the way out.

    Args:
        origins, unit_directions: (R, 3) rays.
        centers: (3,) or (R, 3) centre of the ball for each ray, scene units; None for the origin.

    Returns:
        Outward unit normals (R, 3) at the first intersection, undefined without one, and whether there is one (R,).
    """
    from_center = origins if centers is None else origins - centers
    middle = -(from_center * unit_directions).sum(-1)
    nearest = from_center + middle[:, None] * unit_directions
    squared = RADIUS**2 - nearest.square().sum(-1)
    half = squared.clamp(min=0).sqrt()
    first = torch.where(middle > half, -half, half)  # distance from the nearest point
    return (nearest + first[:, None] * unit_directions) / RADIUS, (squared > 0) & (middle + first > 0)


def cameras_at(positions: Tensor, field_of_view: float, size: int) -> Cameras:
    """Return cameras at `positions` (M, 3), of `field_of_view` degrees and `size` pixels, to the origin, +z up."""
    target, up = torch.zeros(3, dtype=positions.dtype), torch.tensor([0.0, 0.0, 1.0], dtype=positions.dtype)
    poses = torch.stack([look_at(position, target, up) for position in positions]).float()
    focal = torch.full((len(positions),), size / 2 / math.tan(math.radians(field_of_view) / 2))
    middle, sizes = torch.full_like(focal, size / 2), torch.full((len(positions),), size)
    return Cameras(poses, focal, focal, middle, middle, sizes, sizes)
