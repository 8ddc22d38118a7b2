"""Camera paths for animations."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from framework.cameras import Cameras
from framework.kernels.math import safe_normalize


def look_at(position: Tensor, target: Tensor, up: Tensor) -> Tensor:
    """Camera-to-world (3, 4) of a camera at `position` (3,) that looks at `target` (3,), with `up` (3,) upwards.

    Looking along `up` itself leaves the roll undetermined; x is then taken as the right-hand side's reference.
    """
    back = safe_normalize(position - target)
    right = torch.linalg.cross(up, back)
    if right.norm() < 1e-6:
        right = torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0]), back)
    right = safe_normalize(right)
    return torch.stack([right, torch.linalg.cross(back, right), back, position], dim=-1)


def orbit(cameras: Cameras, center: Tensor, num_frames: int) -> Cameras:
    """Cameras on a horizontal circle around `center` (3,), looking at it.

    Height and radius are the mean ones of `cameras`; intrinsics are the first one's.
    """
    offsets = cameras.camera_to_worlds[:, :, 3] - center
    height, radius = offsets[:, 2].mean(), offsets[:, :2].norm(dim=-1).mean()
    angles = torch.arange(num_frames) * (2 * torch.pi / num_frames)
    circle = torch.stack([radius * angles.cos(), radius * angles.sin(), height.expand(num_frames)], dim=-1)
    up = torch.tensor([0.0, 0.0, 1.0])
    poses = torch.stack([look_at(center + offset, center, up) for offset in circle])
    return replace_poses(cameras, poses)


def replace_poses(cameras: Cameras, poses: Tensor) -> Cameras:
    """Cameras at `poses` (K, 3, 4) with the intrinsics of the first of `cameras`."""
    return replace(cameras[torch.zeros(len(poses), dtype=torch.long)], camera_to_worlds=poses)
