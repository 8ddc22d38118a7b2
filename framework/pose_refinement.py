"""Camera poses that are learnt along with the scene, where they were only estimated."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import torch
from torch import Tensor, nn

from framework.cameras import Cameras
from framework.kernels.math import cross_matrix
from framework.rays import Rays

Group = Literal["SO3xR3", "SE3"]


class PoseRefinement(nn.Module):
    """A small rigid motion for each training camera, in the scene's frame; none at first.

    Args:
        count: cameras.
        group: SO3xR3: the camera turns about its own centre, and its centre is moved. SE3: one screw motion about the
            scene's origin.
    """

    def __init__(self, count: int, group: Group = "SO3xR3") -> None:
        super().__init__()
        self.group = group
        self.tangents = nn.Parameter(torch.zeros(count, 6))

    def motions(self) -> Tensor:
        """(M, 3, 4) rotations and translations: the exponentials of (M, 6) translations and rotation vectors."""
        move, turn = self.tangents[:, :3], self.tangents[:, 3:]
        generator = torch.cat([cross_matrix(turn), move[:, :, None]], dim=-1)
        if self.group == "SO3xR3":
            # The matrix exponential has a value and a gradient at zero, where Rodrigues' formula has 0 / 0.
            return torch.cat([torch.linalg.matrix_exp(generator[:, :, :3]), move[:, :, None]], dim=-1)
        return torch.linalg.matrix_exp(nn.functional.pad(generator, (0, 0, 0, 1)))[:, :3]

    def forward(self, rays: Rays) -> Rays:
        """The rays of training cameras as they are believed to be; others as they are."""
        if rays.camera_indices is None:
            return rays
        motions = self.motions()[rays.camera_indices]
        turned = (motions[:, :, :3] * rays.directions[:, None]).sum(-1)
        origins = rays.origins
        if self.group == "SE3":
            origins = (motions[:, :, :3] * origins[:, None]).sum(-1)
        return replace(rays, origins=origins + motions[:, :, 3], directions=turned)

    @torch.no_grad()
    def refined(self, cameras: Cameras) -> Cameras:
        """The training cameras (M) where they are believed to be."""
        motions, poses = self.motions(), cameras.camera_to_worlds
        turned, centres = motions[:, :, :3] @ poses[:, :, :3], poses[:, :, 3:]
        if self.group == "SE3":
            centres = motions[:, :, :3] @ centres
        return replace(cameras, camera_to_worlds=torch.cat([turned, centres + motions[:, :, 3:]], dim=-1))
