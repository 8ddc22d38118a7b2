"""Optimisation of estimated camera poses together with the scene."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import torch
from torch import Tensor, nn

from nerfloom.base.optimised import Optimised
from nerfloom.cameras.pose_propagation import propagated_poses
from nerfloom.cameras.rigid_motion import rigid_motions
from nerfloom.geometry.rays import Rays

Group = Literal["SO3xR3", "SE3"]
"""Parameterisation of a small rigid motion."""
POSE_REASONS = {
    "exact": "the poses are exact",
    "photographs": "the poses were estimated from the photographs",
    "device": "the poses were tracked by the device",
}
"""Reason for or against refining poses, by their source (`Scene.poses`)."""


class PoseRefinement(nn.Module):
    """A small rigid motion for each training camera, in the scene's frame; initially the identity.

    The data give poses, and the scene is learnt as the moved cameras see it. So the moved poses are in the scene's
    frame.

    Args:
        count: number of cameras.
        group: SO3xR3: the camera is rotated about its own centre, and the centre is translated. SE3: one screw motion
            about the scene's origin.
        given: (count, 3, 4) poses to be refined. Other cameras then follow nearby ones (`propagated_poses`), because
            all training cameras may drift together with the scene. If None, other cameras stay unchanged.
    """

    given: Tensor | None
    optimised: Optimised | None = None

    def __init__(self, count: int, group: Group = "SO3xR3", given: Tensor | None = None) -> None:
        super().__init__()
        self.group = group
        self.register_buffer("given", given, persistent=False)
        self.tangents = nn.Parameter(torch.zeros(count, 6))

    def motions(self, chosen: slice = slice(None)) -> Tensor:
        """Return the motions (M, 3, 4) of the cameras `chosen`, or all: exponentials of (M, 6) numbers."""
        return rigid_motions(self.tangents[chosen], self.group == "SE3")

    def forward(self, rays: Rays) -> Rays:
        """Move `rays` of training cameras from their given to their refined poses, with a gradient.

        Raises:
            ValueError: if the rays have no camera indices.
        """
        if rays.camera_indices is None:
            raise ValueError("poses are refined along rays of training cameras")
        # Not `motions[camera_indices]`: the order of summation of its gradient depends on the threads.
        motions = nn.functional.embedding(rays.camera_indices, self.motions().flatten(1)).view(-1, 3, 4)
        directions = (motions[:, :, :3] * rays.directions[:, None]).sum(-1)
        origins = rays.origins
        if self.group == "SE3":
            origins = (motions[:, :, :3] * origins[:, None]).sum(-1)
        return replace(rays, origins=origins + motions[:, :, 3], directions=directions)

    def pose(self, index: int, given: Tensor) -> Tensor:
        """Return the refined pose of training camera `index`, `given` as (3, 4), with a gradient."""
        return self._moved(given[None], slice(index, index + 1))[0]

    @torch.no_grad()
    def refined(self, poses: Tensor, training: bool) -> Tensor:
        """Return camera poses (M, 3, 4) of the data, refined, without a gradient.

        Args:
            poses: (M, 3, 4) given poses, on any device.
            training: whether they are the poses of all training cameras, in their order. Other poses follow nearby
                training cameras. So do poses of training cameras if some of them are missing.
        """
        here = poses.to(self.tangents)
        if training and len(here) == len(self.tangents):
            return self._moved(here).to(poses)
        if self.given is None:
            return poses
        return propagated_poses(here, self.given, self._moved(self.given)).to(poses)

    def _moved(self, poses: Tensor, chosen: slice = slice(None)) -> Tensor:
        motions = self.motions(chosen)
        # Products and sums, because autocast would round a matrix product to bfloat16.
        moved = (motions[:, :, :3, None] * poses[:, None]).sum(2)
        centres = moved[:, :, 3:] if self.group == "SE3" else poses[:, :, 3:]
        return torch.cat([moved[:, :, :3], centres + motions[:, :, 3:]], dim=-1)
