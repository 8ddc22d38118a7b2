"""Camera paths for animations."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from framework.cameras.cameras import Cameras
from framework.kernels.math import safe_normalize

STOPS = 24
"""Ratio of the number of cameras to the standard deviation, in cameras, of the weights of an interpolated path."""


def look_at(position: Tensor, target: Tensor, up: Tensor) -> Tensor:
    """Return the camera-to-world pose (3, 4) of a camera at `position` (3,) that looks at `target` (3,).

    The `up` direction (3,) is upwards in the image; if the camera looks along it, +y is used instead.
    """
    back = safe_normalize(position - target)
    right = torch.linalg.cross(up, back)
    if right.norm() < 1e-6:
        right = torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0]), back)
    right = safe_normalize(right)
    return torch.stack([right, torch.linalg.cross(back, right), back, position], dim=-1)


def orbit(cameras: Cameras, center: Tensor, num_frames: int) -> Cameras:
    """Return cameras on a horizontal circle, looking at its centre.

    Height and radius are the means of the given cameras', and intrinsics those of the first.

    Args:
        cameras: M cameras.
        center: (3,) centre, scene units.
        num_frames: number of cameras on the circle.
    """
    offsets = cameras.camera_to_worlds[:, :, 3] - center
    height, radius = offsets[:, 2].mean(), offsets[:, :2].norm(dim=-1).mean()
    angles = torch.arange(num_frames) * (2 * torch.pi / num_frames)
    circle = torch.stack([radius * angles.cos(), radius * angles.sin(), height.expand(num_frames)], dim=-1)
    up = torch.tensor([0.0, 0.0, 1.0])
    poses = torch.stack([look_at(center + offset, center, up) for offset in circle])
    return replace_poses(cameras, poses)


def interpolate(cameras: Cameras, num_frames: int) -> Cameras:
    """Return cameras along a smooth path past given cameras, in their order, without the shaking of a hand.

    A pose is the mean of poses nearby in that order, weighted by a Gaussian; its rotation is the one closest to the
    mean of the matrices. Intrinsics are those of the first camera.

    Args:
        cameras: M cameras.
        num_frames: number of cameras on the path.
    """
    count = len(cameras)
    width = max(count / STOPS, 0.5)
    positions = torch.linspace(0, count - 1, num_frames, dtype=torch.float64)
    weights = torch.exp(-0.5 * ((positions[:, None] - torch.arange(count)) / width).square())
    weights = weights / weights.sum(-1, keepdim=True)
    means = torch.einsum("fm,mij->fij", weights, cameras.camera_to_worlds.double())
    u, _, vh = torch.linalg.svd(means[:, :, :3])
    flips = torch.ones(num_frames, 3, dtype=torch.float64)
    flips[:, 2] = torch.linalg.det(u @ vh)
    rotations = (u * flips[:, None]) @ vh
    return replace_poses(cameras, torch.cat([rotations, means[:, :, 3:]], dim=-1).float())


def replace_poses(cameras: Cameras, poses: Tensor) -> Cameras:
    """Return cameras with `poses` (K, 3, 4) and the intrinsics of the first of `cameras`."""
    return replace(cameras[torch.zeros(len(poses), dtype=torch.long)], camera_to_worlds=poses)
