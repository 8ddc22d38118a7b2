"""An octree with values in its leaves, as a file holds it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from nerfloom.cameras.poses import Placement
from nerfloom.data.scene import Scene
from nerfloom.kernels.octree.layout import OctreeLayout
from nerfloom.kernels.octree.packed import CODES, PackedLeaves


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
        return replace(self, layout=self.layout.to(device), leaves=self.leaves.to(device))

    @property
    def degree(self) -> int:
        """Degree of the harmonics of colours."""
        return math.isqrt(self.leaves.colors.shape[1] // 3) - 1

    def part(self, kept: Tensor) -> Octree:
        """Return the octree with some of its leaves.

        Args:
            kept: (N,) int64 indices of the leaves that are kept, each once.
        """
        layout, rows = self.layout.part(kept)
        leaves = replace(self.leaves, codes=self.leaves.codes[rows], colors=self.leaves.colors[rows])
        return replace(self, layout=layout, leaves=leaves)

    def finest(self, count: int) -> Octree:
        """Return the octree with at most `count` levels, the finest ones."""
        levels, leaves = self.layout.levels[:count], self.leaves
        layout = levels[0].within(levels[1:])
        kept = layout.num_leaves
        leaves = replace(
            leaves, codes=leaves.codes[:kept], table=leaves.table[: CODES * len(levels)], colors=leaves.colors[:kept]
        )
        return replace(self, layout=layout, leaves=leaves)

    @property
    def scene(self) -> Scene:
        """The scene with the facts that the octree has, without cameras.

        It starts at a camera itself: `near` is for the training cameras, and others may stand closer.
        """
        return Scene(
            box=self.layout.box,
            near=0.0,
            far=self.far,
            num_cameras=0,
            has_alpha=self.has_alpha,
            moving=False,
            image_size=self.image_size,
            unbounded=self.layout.coarser is not None,
            z_is_up=True,
        )
