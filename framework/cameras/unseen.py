"""Unobserved views between and around the training cameras: RegNeRF (Niemeyer et al. 2022), section 3.2."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from nerfloom.geometry.alignment import nearest_rotations
from nerfloom.geometry.rays import Rays
from nerfloom.kernels.math import safe_normalize

NEIGHBOURS = 3
"""Number of neighbouring cameras whose poses are averaged into an unobserved view."""
REACH = 1.25
"""Size of the triangle that positions are drawn from, relative to the triangle of the three cameras."""


def unseen_patches(rays: Rays, poses: Tensor, side: int, stride: float = 1.0) -> Rays:
    """Return square patches of rays through random views, one for each of P rays of training cameras.

    A camera moves to a view between and around itself and its neighbours. Its ray moves along and becomes the centre of
    a patch. So patches have the fields of view, lenses and times of the training cameras.

    Args:
        rays: P rays of training cameras, in the scene's frame.
        poses: (M, 3, 4) camera-to-scene of the training cameras.
        side: rays along an edge of a patch.
        stride: distance of neighbouring rays of a patch, in pixels.

    Returns:
        P side^2 rays, patch by patch, row by row.

    Raises:
        ValueError: if the rays have no cameras or no pixel radii.
    """
    if rays.camera_indices is None:
        raise ValueError("unseen views are made from rays of training cameras")
    poses, cameras = poses.cpu(), rays.camera_indices.cpu()
    before, after = poses[cameras], unseen_poses(poses, cameras)
    return square_patches(moved_rays(rays, before.to(rays.origins), after.to(rays.origins)), side, stride)


def unseen_poses(poses: Tensor, near: Tensor) -> Tensor:
    """Return random poses, each between and around a given camera and its two nearest neighbours.

    The position is uniformly distributed over a triangle, `REACH` times as large as the one of the three cameras. The
    rotation is the closest to the mean of their rotations, with the same weights.

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
    chosen = poses[apart.topk(count, largest=False).indices].double()
    # Exponential variates divided by their sum are uniform over weights with sum 1.
    drawn = -torch.rand(len(near), count, dtype=torch.float64).clamp(min=1e-12).log()
    weights = REACH * drawn / drawn.sum(-1, keepdim=True) + (1 - REACH) / count
    mean = (weights[:, :, None, None] * chosen).sum(1)
    return torch.cat([nearest_rotations(mean[:, :, :3]), mean[:, :, 3:]], dim=-1).to(poses)


def moved_rays(rays: Rays, before: Tensor, after: Tensor) -> Rays:
    """Return rays moved along with their cameras; they no longer belong to a training camera.

    Args:
        rays: P rays.
        before: (P, 3, 4) pose of each ray's camera.
        after: (P, 3, 4) new pose of the camera.
    """
    turn = (after[:, :, None, :3] * before[:, None, :, :3]).sum(-1)  # without a product, which autocast would round
    origins = (turn * (rays.origins - before[:, :, 3])[:, None]).sum(-1) + after[:, :, 3]
    return replace(rays, origins=origins, directions=(turn * rays.directions[:, None]).sum(-1), camera_indices=None)


def square_patches(rays: Rays, side: int, stride: float = 1.0) -> Rays:
    """Return a square of side^2 rays around each of P rays, row by row, all from the same origin.

    Args:
        rays: P rays with pixel radii, the centres of the squares.
        side: rays along an edge of a square.
        stride: distance of neighbouring rays, in pixels.

    Returns:
        P side^2 rays.

    Raises:
        ValueError: if the rays have no pixel radii.
    """
    if rays.pixel_radii is None:
        raise ValueError("patches of rays need the radii of their pixels")
    ahead, radii = rays.directions, stride * rays.pixel_radii
    axis = torch.eye(3, dtype=ahead.dtype, device=ahead.device)[ahead.abs().argmin(-1)]  # the one most across
    right = safe_normalize(torch.linalg.cross(ahead, axis))
    down = torch.linalg.cross(ahead, right)
    pixel = 3**0.5 * radii  # a radius is 2 / sqrt(12) pixels
    steps = torch.arange(side, dtype=ahead.dtype, device=ahead.device) - (side - 1) / 2
    places = torch.cartesian_prod(steps, steps)
    offsets = places[:, 1, None] * right[:, None] + places[:, 0, None] * down[:, None]
    directions = safe_normalize(ahead[:, None] + pixel[:, None, None] * offsets).view(-1, 3)
    middles = torch.arange(len(rays), device=ahead.device).repeat_interleave(side * side)
    return replace(rays[middles], directions=directions, pixel_radii=radii[middles])
