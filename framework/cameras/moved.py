"""Cameras in another scene of the same things."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from nerfloom.cameras.cameras import Cameras


def moved_cameras(cameras: Cameras, rotation: Tensor, scale: float, shift: Tensor) -> Cameras:
    """Return cameras moved to another scene by a similarity, so that they see the same there, on the same device.

    Poses are computed in float64, since a scene may be far from its origin.

    Args:
        cameras: M cameras.
        rotation: (3, 3) of the similarity from their scene to the other, x -> scale * rotation @ x + shift.
        scale: its scale.
        shift: (3,) its shift.
    """
    poses = cameras.camera_to_worlds.cpu().double()
    positions = scale * poses[:, :, 3] @ rotation.T + shift
    placed = torch.cat([rotation @ poses[:, :, :3], positions[..., None]], dim=-1).to(cameras.camera_to_worlds)
    # The focal lengths of parallel rays are pixels per scene unit; others are the same in every scene.
    per_unit = 1 / scale if cameras.model == "orthographic" else 1.0
    return replace(cameras, camera_to_worlds=placed, fx=per_unit * cameras.fx, fy=per_unit * cameras.fy)
