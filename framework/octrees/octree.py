"""An octree with values in its leaves: what a file holds."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from nerfloom.cameras.poses import Placement
from nerfloom.data.scene import Scene
from nerfloom.kernels.octree.layout import OctreeLayout
from nerfloom.kernels.octree.packed import PackedLeaves


@dataclass(frozen=True)
class Octree:
    """An octree in the frame of a scene."""

    layout: OctreeLayout
    """Where the leaves are."""
    leaves: PackedLeaves
    """Their values."""
    placement: Placement
    """Placement of the input in the scene."""
    near: float
    """Distance from a camera where the scene starts, scene units."""
    far: float
    """Distance from a camera where the scene ends, scene units."""
    has_alpha: bool
    """Whether the images have alpha, so that pictures have a white background."""
    image_size: int
    """Longer side of the images, pixels."""

    def to(self, device: torch.device | str) -> Octree:
        """Return the octree on `device`."""
        return Octree(
            self.layout.to(device),
            self.leaves.to(device),
            self.placement,
            self.near,
            self.far,
            self.has_alpha,
            self.image_size,
        )

    @property
    def scene(self) -> Scene:
        """The scene as far as the octree knows it, without cameras."""
        return Scene(
            box=self.layout.box,
            near=self.near,
            far=self.far,
            num_cameras=0,
            has_alpha=self.has_alpha,
            moving=False,
            image_size=self.image_size,
        )
