"""Move poses of other cameras along with the refined poses of nearby training cameras."""

from __future__ import annotations

import torch
from torch import Tensor

from nerfloom.geometry.alignment import align_cameras, nearest_rotations

KERNEL_WIDTH = 3.0
"""Training cameras within this distance have about equal weight, so that no single camera's error dominates. The unit
is the median distance from a camera to its nearest neighbour."""
WEIGHT_EXPONENT = 4.0
"""Exponent of the distance in the weights of farther cameras (Shepard 1968)."""
MAX_SPACING_CAMERAS = 64
"""Maximum number of cameras used to estimate the spacing."""


def propagated_poses(poses: Tensor, given: Tensor, refined: Tensor) -> Tensor:
    """Move poses as the cameras near them were moved.

    Every pose follows the similarity from given to refined poses. It also gets the weighted mean of the remaining
    motions of nearby training cameras: a device's pose error changes slowly as it moves, so neighbouring photographs
    share it. Far from all training cameras only the similarity remains.

    Args:
        poses: (N, 3, 4) camera-to-scene poses of other cameras, in the frame of `given`.
        given: (M, 3, 4) poses of the training cameras, M >= 1.
        refined: (M, 3, 4) the same poses after refinement.

    Returns:
        (N, 3, 4) the moved poses.
    """
    before, after, others = (part.cpu().double() for part in (given, refined, poses))
    scale, rotation, translation = align_cameras(before, after)
    centers, positions = before[:, :, 3], others[:, :, 3]
    weights = _nearness(positions, centers)
    turns = (after[:, :, :3] @ before[:, :, :3].transpose(1, 2)).flatten(1)
    turned = nearest_rotations((weights @ turns).view(-1, 3, 3)) @ others[:, :, :3]
    left_over = after[:, :, 3] - (scale * centers @ rotation.T + translation)
    moved = scale * positions @ rotation.T + translation + weights @ left_over
    return torch.cat([turned, moved[:, :, None]], dim=-1).to(poses)


def _nearness(positions: Tensor, centers: Tensor) -> Tensor:
    """Return the weights (N, M) of cameras at `centers` (M, 3) for `positions` (N, 3); each row sums to 1."""
    spacing = 0.0
    if len(centers) > 1:
        some = centers[:: -(-len(centers) // MAX_SPACING_CAMERAS)]
        spacing = float(torch.cdist(some, centers).topk(2, largest=False).values[:, 1].median())
    squares = (positions[:, None] - centers).square().sum(-1) + (KERNEL_WIDTH * spacing) ** 2
    # In logarithms, because all cameras may be at one place.
    return (-WEIGHT_EXPONENT / 2 * (squares + torch.finfo(squares.dtype).tiny).log()).softmax(dim=-1)
