"""Unobserved views between and around the training cameras: RegNeRF (Niemeyer et al. 2022), section 3.2."""

from __future__ import annotations

import torch
from torch import Tensor

from nerfloom.geometry.alignment import nearest_rotations

NEIGHBOURS = 3
"""Number of neighbouring cameras; an unobserved view averages their poses."""
REACH = 1.25
"""Size of the triangle that positions are drawn from, relative to the triangle of the three cameras."""
MIN_COSINE = 0.5
"""Minimum cosine between the directions of a camera and of a neighbour whose pose is averaged with it: 60 degrees."""


def unseen_poses(poses: Tensor, near: Tensor) -> Tensor:
    """Return random poses, each between and around a given camera and its two nearest neighbours.

    The position is uniformly distributed over the triangle of the three cameras, enlarged by `REACH`. The
    rotation is the closest to the mean of their rotations, with the same weights. In place of a neighbour that looks
    elsewhere (`MIN_COSINE`) the camera itself is taken, because the mean of both would look at something else again.

    Args:
        poses: (M, 3, 4) camera-to-scene of the cameras.
        near: (P,) int64 index of a camera for each pose.

    Returns:
        (P, 3, 4) poses, of the type of `poses`.
    """
    count = min(NEIGHBOURS, len(poses))
    centers = poses[:, :, 3]
    apart = (centers[near][:, None] - centers).norm(dim=-1)
    apart[torch.arange(len(near)), near] = -1.0  # the camera itself, even if another stands at the same place
    nearest, ahead = apart.topk(count, largest=False).indices, poses[:, :, 2]
    alike = (ahead[nearest] * ahead[near][:, None]).sum(-1) >= MIN_COSINE
    chosen = poses[torch.where(alike, nearest, near[:, None])].double()
    # Exponential variates divided by their sum are uniform over weights with sum 1.
    drawn = -torch.rand(len(near), count, dtype=torch.float64).clamp(min=1e-12).log()
    weights = REACH * drawn / drawn.sum(-1, keepdim=True) + (1 - REACH) / count
    mean = (weights[:, :, None, None] * chosen).sum(1)
    return torch.cat([nearest_rotations(mean[:, :, :3]), mean[:, :, 3:]], dim=-1).to(poses)
