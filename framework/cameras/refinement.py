"""Optimisation of estimated camera poses together with the scene."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import torch
from torch import Tensor, nn

from nerfloom.base.optimised import Optimised
from nerfloom.cameras.cameras import Cameras
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
        """Return the motions (M, 3, 4), exponentials of the (M, 6) translations and rotation vectors.

        Args:
            chosen: the cameras; all if not given.
        """
        return rigid_motions(self.tangents[chosen], self.group == "SE3")

    def forward(self, rays: Rays) -> Rays:
        """Move the rays of training cameras by their refinements, and those of other cameras as their neighbours."""
        if rays.camera_indices is None:
            return self.propagated(rays)
        # Not `motions[camera_indices]`: the order of summation of its gradient depends on the threads.
        motions = nn.functional.embedding(rays.camera_indices, self.motions().flatten(1)).view(-1, 3, 4)
        directions = (motions[:, :, :3] * rays.directions[:, None]).sum(-1)
        origins = rays.origins
        if self.group == "SE3":
            origins = (motions[:, :, :3] * origins[:, None]).sum(-1)
        return replace(rays, origins=origins + motions[:, :, 3], directions=directions)

    @torch.no_grad()
    def propagated(self, rays: Rays) -> Rays:
        """Transform `rays` from the given poses' frame to the refined poses'; lengths are scaled too."""
        if self.given is None:
            return rays
        origins = rays.origins
        if bool((origins == origins[:1]).all()):  # rays of one view
            origins = origins[:1]
        axes = torch.eye(3).to(origins).expand(len(origins), 3, 3)
        poses = torch.cat([axes, origins[:, :, None]], dim=-1)
        moved, scale = propagated_poses(poses, self.given, self._moved(self.given))
        return replace(
            rays,
            origins=moved[:, :, 3].expand_as(rays.origins),
            directions=(moved[:, :, :3] * rays.directions[:, None]).sum(-1),
            nears=scale * rays.nears,
            fars=scale * rays.fars,
        )

    @torch.no_grad()
    def propagated_pose(self, pose: Tensor) -> Tensor:
        """Move the pose of another camera like nearby training cameras (`propagated_poses`).

        Args:
            pose: (3, 4) camera-to-scene pose.
        """
        return pose if self.given is None else propagated_poses(pose[None], self.given, self._moved(self.given))[0][0]

    def pose(self, index: int, given: Tensor) -> Tensor:
        """Return the refined pose (3, 4) of a training camera, with a gradient.

        Args:
            index: index of the training camera.
            given: (3, 4) its given pose.
        """
        return self._moved(given[None], slice(index, index + 1))[0]

    @torch.no_grad()
    def refined(self, cameras: Cameras) -> Cameras:
        """Return the training `cameras` (M) with refined poses."""
        return replace(cameras, camera_to_worlds=self._moved(cameras.camera_to_worlds))

    def _moved(self, poses: Tensor, chosen: slice = slice(None)) -> Tensor:
        motions = self.motions(chosen)
        # Products and sums, because autocast would round a matrix product to bfloat16.
        moved = (motions[:, :, :3, None] * poses[:, None]).sum(2)
        centres = moved[:, :, 3:] if self.group == "SE3" else poses[:, :, 3:]
        return torch.cat([moved[:, :, :3], centres + motions[:, :, 3:]], dim=-1)
