"""A ball of which every picture is known in closed form: its colour tells where its surface faces."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from framework.cameras.cameras import Cameras
from framework.evaluation.paths import look_at

RADIUS = 0.7
"""Radius of the ball, scene units."""


def trace(origins: Tensor, unit_directions: Tensor, centers: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Outward unit normals (R, 3) where rays first meet a ball's surface, and whether they do, (R,) bool.

    A ray that starts inside meets the surface on its way out. Where a ray meets nothing, its normal means nothing.

    Args:
        origins, unit_directions: (R, 3) rays.
        centers: (3,) or (R, 3) of the ball; the origin if None.
    """
    from_center = origins if centers is None else origins - centers
    middle = -(from_center * unit_directions).sum(-1)
    nearest = from_center + middle[:, None] * unit_directions
    squared = RADIUS**2 - nearest.square().sum(-1)
    half = squared.clamp(min=0).sqrt()
    first = torch.where(middle > half, -half, half)  # from the nearest point
    return (nearest + first[:, None] * unit_directions) / RADIUS, (squared > 0) & (middle + first > 0)


def cameras_at(positions: Tensor, field_of_view: float, size: int) -> Cameras:
    """Cameras at positions (M, 3) that look at the origin, z being up.

    Args:
        field_of_view: degrees.
        size: width and height of the pictures, pixels.
    """
    target, up = torch.zeros(3, dtype=positions.dtype), torch.tensor([0.0, 0.0, 1.0], dtype=positions.dtype)
    poses = torch.stack([look_at(position, target, up) for position in positions]).float()
    focal = torch.full((len(positions),), size / 2 / math.tan(math.radians(field_of_view) / 2))
    middle, sizes = torch.full_like(focal, size / 2), torch.full((len(positions),), size)
    return Cameras(poses, focal, focal, middle, middle, sizes, sizes)
