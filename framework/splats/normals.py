"""Normals of Gaussians with a gradient."""

from __future__ import annotations

import torch
from torch import Tensor

from nerfloom.kernels.splats.project import Record, SplatCamera, rotation_matrices
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.rasteriser import Projected


def facing_normals(gaussians: Gaussians, camera: SplatCamera) -> Tensor:
    """Return the shortest axis of each Gaussian, turned towards a camera: unit vectors (N, 3) in the scene's frame.

    The rotations get a gradient. Scales and positions, which choose the axis and its sign, get none.

    Args:
        gaussians: N Gaussians.
        camera: the camera.
    """
    shortest = gaussians.log_scales.detach().argmin(-1)
    axes = rotation_matrices(gaussians.rotations).gather(2, shortest[:, None, None].expand(-1, 3, 1))[..., 0]
    pose = camera.pose.detach().to(axes)
    from_camera = gaussians.means.detach() + pose[:, :3].T @ pose[:, 3]
    away = (axes.detach() * from_camera).sum(-1, keepdim=True) > 0
    return torch.where(away, -axes, axes)


def with_normals(shown: Projected, gaussians: Gaussians, camera: SplatCamera) -> Projected:
    """Return Gaussians on an image with their normals in place of their colours.

    Their image over black is the sum of weight times normal. Unlike the normals that `blend` draws beside colours, it
    has a gradient in the compiled kernels too.

    Args:
        shown: N Gaussians on the image.
        camera: camera of the image.
    """
    records, normals = shown.records, facing_normals(gaussians, camera)
    columns = [records[:, : Record.RED], normals, records[:, Record.DISTANCE :]]
    return shown._replace(records=torch.cat(columns, 1))
