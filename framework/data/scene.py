"""The description of a scene that methods receive."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from nerfloom.base.checked import checked
from nerfloom.base.errors import shown
from nerfloom.geometry.records import TensorRecord

PoseSource = Literal["exact", "photographs", "device"]
"""Source of the cameras' poses: known exactly, estimated from the images, or tracked by the device that took them."""
MAX_CAMERAS = 10**7
"""Maximum number of cameras of a scene read from a file."""
MAX_SIZE = 10**9
"""Maximum side of an image of a scene read from a file, pixels."""
MAX_EXPOSURE = 100.0
"""Maximum exposure of an image of a scene read from a file, stops."""
MAX_COORDINATE = 1e9
"""Maximum coordinate of the box of a scene read from a file, scene units."""


@dataclass(frozen=True)
class Scene(TensorRecord):
    """Properties of the data, read before training."""

    box: Tensor
    """(2, 3) minimum and maximum corner of the region of interest, scene units."""
    near: float
    """Distance from a camera where the scene starts."""
    far: float
    """Distance from a camera where the scene ends."""
    num_cameras: int
    """Number of training images."""
    has_alpha: bool
    """Whether the images have an alpha channel that marks background."""
    moving: bool
    """Whether the images have times."""
    image_size: int
    """Longer side of the largest training image, pixels."""
    unbounded: bool = False
    """Whether there may be visible content outside `box`."""
    poses: PoseSource = "exact"
    """Source of the cameras' poses."""
    z_is_up: bool = False
    """Whether +z is up, as the data or their placement say; False if it is unknown."""
    warped: bool = False
    """Whether rays are in normalised device coordinates, with other lengths and angles than the scene."""
    has_depth: bool = False
    """Whether the images come with depth images."""
    appearance_varies: bool = False
    """Whether light, exposure or camera differ between images."""
    camera_to_worlds: Tensor | None = None
    """(num_cameras, 3, 4) given poses of the training cameras."""
    image_pixels: int | None = None
    """Mean number of pixels of a training image; None if unknown."""
    num_sparse_depths: int = 0
    """Number of pixels with a known distance, from a reconstruction's points."""
    num_times: int = 0
    """Number of distinct times of the training images; 0 if they have none."""
    num_scenes: int = 1
    """Number of scenes in the training images; more than one only for methods that learn from several scenes."""
    exposures: Tensor | None = None
    """(num_cameras,) exposure of the training images as their files state it, stops from the mean; None if unknown."""
    devices: Tensor | None = None
    """(num_cameras,) int64 index of the device that took each training image; None if one took all."""

    @classmethod
    def of(cls, facts: Any) -> Scene:
        """Construct a scene from `facts` read from a file: the fields' values by name.

        Raises:
            ValueError: if the values do not describe a scene.
        """
        scene = checked(cls, facts)
        box, poses, count = scene.box, scene.camera_to_worlds, scene.num_cameras
        if box.shape != (2, 3) or box.dtype != torch.float32 or box.layout != torch.strided:
            raise ValueError(
                f"the scene's box has shape {tuple(box.shape)} and type {box.dtype}; it must be (2, 3) and float32"
            )
        if not bool((box.abs() < MAX_COORDINATE).all()) or not bool((box[0] < box[1]).all()):
            raise ValueError("the scene's box is empty or too large")
        if not 1 <= count <= MAX_CAMERAS or (poses is not None and poses.shape != (count, 3, 4)):
            raise ValueError(f"the scene's number of cameras, {shown(count)}, does not match its poses")
        for name, kind, low, high in (
            ("exposures", torch.float32, -MAX_EXPOSURE, MAX_EXPOSURE),
            ("devices", torch.int64, 0, count - 1),
        ):
            values = getattr(scene, name)
            if values is None:
                continue
            if values.shape != (count,) or values.dtype != kind or not bool(((values >= low) & (values <= high)).all()):
                raise ValueError(f"the scene's {name} do not match its number of cameras, or are out of range")
        if not 0 <= scene.near < scene.far < math.inf or not 1 <= scene.image_size <= MAX_SIZE:
            raise ValueError(
                f"the scene has near {scene.near}, far {scene.far} and images of {shown(scene.image_size)} pixels; "
                "near must be less than far, and sizes positive"
            )
        return scene

    @property
    def ends_in_box(self) -> bool:
        """Return whether every ray ends in the box.

        This is so if images are opaque, a training camera stands in the box, and nothing is outside it.
        """
        if self.camera_to_worlds is None or self.has_alpha or self.unbounded or self.warped:
            return False
        centres = self.camera_to_worlds[..., 3]
        return bool(((centres > self.box[0]) & (centres < self.box[1])).all(-1).any())
