"""What a method is told about the scene it is to learn."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from torch import Tensor

from framework.base.checked import checked
from framework.base.errors import shown

PoseSource = Literal["exact", "photographs", "device"]
MOST_CAMERAS, LARGEST_SIZE, FARTHEST = 10**7, 10**9, 1e9
"""Cameras, pixels of an image's side and scene units of what is believed of a scene that comes out of a file."""


@dataclass(frozen=True)
class Scene:
    """Facts read from the data before anything is trained."""

    box: Tensor
    """(2, 3) smallest and largest corner of the part of space that matters, scene units."""
    near: float
    """Distance from a camera at which the scene may start."""
    far: float
    """Distance from a camera at which the scene ends."""
    num_cameras: int
    """Training images."""
    has_alpha: bool
    """The photographs tell what is background."""
    moving: bool
    """The photographs have times."""
    image_size: int
    """The longer side of the largest training image, pixels."""
    unbounded: bool = False
    """There may be something to see outside `box`."""
    poses: PoseSource = "exact"
    """Where the cameras' poses come from: known; found in the photographs; or tracked by the device that took them."""
    warped: bool = False
    """Rays are those of normalised device coordinates, whose lengths and angles are not the scene's."""
    has_depth: bool = False
    """The photographs come with depth images."""
    appearance_varies: bool = False
    """Light, exposure or camera differ between the photographs."""
    camera_to_worlds: Tensor | None = None
    """(num_cameras, 3, 4) the training cameras' poses as they are given."""

    @classmethod
    def of(cls, facts: Any) -> Scene:
        """From facts out of a file.

        Raises: ValueError where they are none that a scene can have.
        """
        scene = checked(cls, facts)
        box, poses, count = scene.box, scene.camera_to_worlds, scene.num_cameras
        if box.shape != (2, 3) or box.dtype != torch.float32 or box.layout != torch.strided:
            raise ValueError(f"the scene's box has the shape {tuple(box.shape)}; it must be two corners")
        if not bool((box.abs() < FARTHEST).all()) or not bool((box[0] < box[1]).all()):
            raise ValueError("the scene's box has no size, or is beyond measure")
        if not 1 <= count <= MOST_CAMERAS or (poses is not None and poses.shape != (count, 3, 4)):
            raise ValueError(f"the scene has {shown(count)} cameras, which do not fit its poses")
        if not 0 <= scene.near < scene.far < math.inf or not 1 <= scene.image_size <= LARGEST_SIZE:
            raise ValueError(f"near {scene.near}, far {scene.far}, images of {shown(scene.image_size)} pixels")
        return scene

    def to(self, device: torch.device | str) -> Scene:
        """The same facts on `device`."""
        given = None if self.camera_to_worlds is None else self.camera_to_worlds.to(device)
        return replace(self, box=self.box.to(device), camera_to_worlds=given)
