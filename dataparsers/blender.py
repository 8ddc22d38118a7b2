"""Renders: transforms_{train,val,test}.json as written by Blender scripts, for NeRF-Synthetic and any other scene.

NeRF-Synthetic (Mildenhall et al. 2020) states an angle of view, and its cameras look at the origin from 4.03 units
away; box, near and far come from its paper. Any other scene is placed in the same box, for all units and positions
(`nerfloom.dataparsers.region`). Normals beside images, as in Shiny Blender (Verbin et al. 2022), are true ones
to judge a method's by.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from nerfloom import DataError, DataParser, ParsedScene
from nerfloom.base.console import say
from nerfloom.base.splits import Split
from nerfloom.cameras.camera_path import read_transforms
from nerfloom.cameras.poses import Placement
from nerfloom.data import diffuse_light, normals
from nerfloom.dataparsers.captured import placed_cameras
from nerfloom.dataparsers.region import HALF_SIZE, Region, cube_at_origin, find_region
from nerfloom.dataparsers.renders import Renders, read_renders

TRANSFORMS = "transforms_train.json"
"""File that identifies the format."""
MAX_SCALES = 8
"""Maximum number of sizes of an image; at the eighth, a pixel is the mean of 16,384 pixels."""
DISTANCE, NEAR, FAR = 4.0311, 2.0, 6.0
"""Distance of NeRF-Synthetic's cameras from the origin, and its near and far, in the input's units."""
TOLERANCE = 0.01
"""Maximum deviation from NeRF-Synthetic's camera positions, relative to their distance."""
ORIGIN = Placement(torch.eye(4, dtype=torch.float64)[:3], 1.0)
"""Placement of a scene that is not moved."""


@dataclass(frozen=True)
class Blender(DataParser):
    """Flags of the blender format."""

    downscale_factor: int = 1
    """Integer factor for reducing images."""
    scale_factor: float = 1.0
    """Factor for camera positions, and so for the scene."""
    half_size: float | None = None
    """Half the side of the cube around the origin that holds the scene, in the input's units. Default: 1.5 for
    NeRF-Synthetic; for other data, a cube from silhouettes or around the point that the cameras look at."""
    near: float | None = None
    """Distance from a camera where the scene starts, in the input's units. Default: 2 for NeRF-Synthetic, otherwise
    from cameras and cube."""
    far: float | None = None
    """Distance from a camera where the scene ends, in the input's units. Default: 6 for NeRF-Synthetic, otherwise
    from cameras and cube."""
    placement: Path | None = None
    """dataparser_transforms.json of a run. Its placement is used instead of one from silhouettes and cameras."""
    multiscale: int = 1
    """Number of sizes of each image in use: 1, 1/2, 1/4, ... The loss is weighted by the area of pixels. 4 is
    Mip-NeRF's multiscale protocol."""

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        file = path / TRANSFORMS
        return file.is_file() and not has_times(file)

    def parse(self, path: Path | None, split: Split) -> ParsedScene:
        if path is None:
            raise DataError("the blender format needs a folder: --data DIR")
        self._check_flags()
        renders = read_renders(path, split)
        region, stays = self._region(renders if split == "train" else _training(path, renders))
        placement = ORIGIN if stays else region.placement
        placement = replace(placement, scale=placement.scale * self.scale_factor)
        if not stays and self.placement is not None:
            placement = read_transforms(self.placement)
        if not stays and split == "train":
            say(f"{path}: the scene is {region.description} (else: --half-size, --near, --far)")
        images, half = renders.images, region.half if stays else HALF_SIZE
        return ParsedScene(
            image_paths=images.paths,
            cameras=placed_cameras(images, placement),
            box=torch.tensor([[-1.0], [1.0]]).expand(2, 3) * half * self.scale_factor,
            near=(region.near if self.near is None else self.near) * placement.scale,
            far=(region.far if self.far is None else self.far) * placement.scale,
            times=images.times,
            transform=None if stays else placement.transform,
            scale=placement.scale,
            downscale_factor=self.downscale_factor,
            num_scales=self.multiscale,
            normal_paths=normals.files_beside(images.paths, normals.ENDING),
            light_paths=normals.files_beside(images.paths, diffuse_light.ENDING),
            unbounded=region.unbounded,
        )

    def _check_flags(self) -> None:
        if self.downscale_factor < 1:
            raise DataError(f"--downscale-factor is {self.downscale_factor}; it must be an integer of at least 1")
        if not 1 <= self.multiscale <= MAX_SCALES:
            raise DataError(f"--multiscale is {self.multiscale}; it must be from 1 to {MAX_SCALES}")
        for name in ("scale_factor", "half_size"):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                raise DataError(f"--{name.replace('_', '-')} is {value}; it must be above zero")

    def _region(self, training: Renders) -> tuple[Region, bool]:
        """Return the region shown in the training images, and whether the scene keeps its position."""
        half = HALF_SIZE if self.half_size is None else self.half_size
        if _is_nerf_synthetic(training):
            return Region(torch.zeros(3), half, NEAR, FAR, False, "NeRF-Synthetic's"), True
        images = training.images
        if self.half_size is not None:
            return cube_at_origin(placed_cameras(images, ORIGIN), half), True
        middle = images.poses[:, :3, 3].mean(0)  # float32 is precise relative to it
        cameras = placed_cameras(images, Placement(torch.cat([torch.eye(3).double(), -middle[:, None]], -1), 1.0))
        cube = None if training.cube is None else (training.cube[0] - middle, training.cube[1])
        region = find_region(cameras, images.paths, images.times is not None, cube)
        return replace(region, center=region.center + middle), False


def has_times(file: Path) -> bool:
    """Return whether the first frame of the transforms file `file` has a time. Never raises."""
    try:
        frames = json.loads(file.read_bytes()).get("frames")
        return isinstance(frames, list) and bool(frames) and isinstance(frames[0], dict) and "time" in frames[0]
    except (OSError, ValueError, RecursionError, AttributeError):
        return False


def _training(path: Path, others: Renders) -> Renders:
    """Return the training images, which determine the placement of all splits, or `others` if there are none."""
    try:
        return read_renders(path, "train", is_wanted=False)
    except DataError:  # reported when they are requested
        return others


def _is_nerf_synthetic(renders: Renders) -> bool:
    """Return whether the cameras are as in NeRF-Synthetic, looking at the origin."""
    images = renders.images
    origins, ahead = images.poses[:, :3, 3], -images.poses[:, :3, 2]
    depths = -(origins * ahead).sum(-1)  # of the origin
    beside = (origins + depths[:, None] * ahead).norm(dim=-1)
    shown = (images.sizes / images.intrinsics[:, :2]).amax(-1) / 2 * DISTANCE
    near_there = ((depths - DISTANCE).abs() < TOLERANCE * DISTANCE) & (beside < TOLERANCE * DISTANCE)
    return renders.only_angle and bool((near_there & (shown < HALF_SIZE)).all())
