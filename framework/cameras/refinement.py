"""Camera poses that are learnt along with the scene, where they were only estimated."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import torch
from torch import Tensor, nn

from framework.base.optimised import Optimised
from framework.cameras.cameras import Cameras
from framework.geometry.alignment import align_cameras
from framework.geometry.rays import Rays
from framework.kernels.math import cross_matrix

Group = Literal["SO3xR3", "SE3"]


class PoseRefinement(nn.Module):
    """A small rigid motion for each training camera, in the scene's frame; none at first.

    Args:
        count: cameras.
        group: SO3xR3: the camera turns about its own centre, and its centre is moved. SE3: one screw motion about the
            scene's origin.
        given: (count, 3, 4) the poses that are refined. Together they may drift, along with all that is learnt; other
            cameras then follow by the similarity that takes the given ones to the refined ones. Without them, other
            cameras are left where they are.
    """

    given: Tensor | None
    optimised: Optimised | None = None

    def __init__(self, count: int, group: Group = "SO3xR3", given: Tensor | None = None) -> None:
        super().__init__()
        self.group = group
        self.register_buffer("given", given, persistent=False)
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
        """The rays of training cameras as they are believed to be; those of others where they then are."""
        if rays.camera_indices is None:
            return self.carried(rays)
        # Not `motions[camera_indices]`, whose gradient is added up in whatever order threads come.
        motions = nn.functional.embedding(rays.camera_indices, self.motions().flatten(1)).view(-1, 3, 4)
        turned = (motions[:, :, :3] * rays.directions[:, None]).sum(-1)
        origins = rays.origins
        if self.group == "SE3":
            origins = (motions[:, :, :3] * origins[:, None]).sum(-1)
        return replace(rays, origins=origins + motions[:, :, 3], directions=turned)

    @torch.no_grad()
    def carried(self, rays: Rays) -> Rays:
        """Rays of the given poses' frame as rays of the refined poses'; lengths change with the scale between them."""
        if self.given is None:
            return rays
        refined = self._moved(self.given)
        scale, rotation, translation = align_cameras(self.given.cpu(), refined.cpu())
        rotation, translation = rotation.to(rays.origins), translation.to(rays.origins)
        return replace(
            rays,
            origins=scale * (rotation * rays.origins[:, None]).sum(-1) + translation,
            directions=(rotation * rays.directions[:, None]).sum(-1),
            nears=scale * rays.nears,
            fars=scale * rays.fars,
        )

    @torch.no_grad()
    def refined(self, cameras: Cameras) -> Cameras:
        """The training cameras (M) where they are believed to be."""
        return replace(cameras, camera_to_worlds=self._moved(cameras.camera_to_worlds))

    def _moved(self, poses: Tensor) -> Tensor:
        motions = self.motions()
        # Products and sums rather than a matrix product, which autocast would round to bfloat16.
        moved = (motions[:, :, :3, None] * poses[:, None]).sum(2)
        centres = moved[:, :, 3:] if self.group == "SE3" else poses[:, :, 3:]
        return torch.cat([moved[:, :, :3], centres + motions[:, :, 3:]], dim=-1)
