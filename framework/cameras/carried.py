"""Poses of other cameras, carried along as the poses of the training cameras around them are refined."""

from __future__ import annotations

import torch
from torch import Tensor

from nerfloom.geometry.alignment import align_cameras, nearest_rotations

WIDTH = 3.0
"""Distance within which training cameras count alike, in median distances of one to the nearest other: a camera that
passes among them follows no single one's error."""
FALL = 4.0
"""Power of the distance with which they count less farther away (Shepard 1968)."""
MEASURED = 64
"""Most cameras of which the distance to the nearest other is measured."""


def carried_poses(poses: Tensor, given: Tensor, refined: Tensor) -> tuple[Tensor, float]:
    """Move poses as the cameras near them were moved.

    All follow the similarity from given to refined poses, and the mean of what is left over of the motions of the
    training cameras, weighted by nearness: a device's errors change slowly as it moves, so that they are those of the
    photographs taken around it. Far from all cameras it is the similarity alone.

    Args:
        poses: (N, 3, 4) camera-to-scene poses of other cameras, in the frame of `given`.
        given: (M, 3, 4) poses of the training cameras, M >= 1.
        refined: (M, 3, 4) the same after refinement.

    Returns:
        The moved poses (N, 3, 4), and the scale of the similarity, by which lengths grow.
    """
    before, after, others = (part.cpu().double() for part in (given, refined, poses))
    scale, rotation, translation = align_cameras(before, after)
    centers, positions = before[:, :, 3], others[:, :, 3]
    weights = _nearness(positions, centers)
    turns = (after[:, :, :3] @ before[:, :, :3].transpose(1, 2)).flatten(1)
    turned = nearest_rotations((weights @ turns).view(-1, 3, 3)) @ others[:, :, :3]
    left_over = after[:, :, 3] - (scale * centers @ rotation.T + translation)
    moved = scale * positions @ rotation.T + translation + weights @ left_over
    return torch.cat([turned, moved[:, :, None]], dim=-1).to(poses), scale


def _nearness(positions: Tensor, centers: Tensor) -> Tensor:
    """Return the weights (N, M), of sum 1, that cameras at `centers` (M, 3) have at `positions` (N, 3)."""
    spacing = 0.0
    if len(centers) > 1:
        some = centers[:: -(-len(centers) // MEASURED)]
        spacing = float(torch.cdist(some, centers).topk(2, largest=False).values[:, 1].median())
    squares = (positions[:, None] - centers).square().sum(-1) + (WIDTH * spacing) ** 2
    # By logarithms, as all may be at one place.
    return (-FALL / 2 * (squares + torch.finfo(squares.dtype).tiny).log()).softmax(dim=-1)
