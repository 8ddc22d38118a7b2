"""Placement of a captured scene: up direction, origin and scale, from its cameras."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from nerfloom import ParsedScene
from nerfloom.base.console import say
from nerfloom.base.splits import Split
from nerfloom.cameras.camera_path import read_transforms
from nerfloom.cameras.poses import Placement, enlargement, place
from nerfloom.dataparsers.camera_spread import MIN_PARALLAX, camera_spread, warning
from nerfloom.dataparsers.posed_images import Captured, PosedImages
from nerfloom.geometry.local_origin import local_origin, rounding

Applied = tuple[Tensor, float]
"""Rigid transform (4, 4) from the original frame to the frame of a format's poses, and units of the latter per unit of
the original: x becomes `scale * (transform @ x)`."""


def placement_of(flags: Captured, images: PosedImages, split: Split, applied: Applied | None) -> Placement:
    """Return the placement of a scene, and report if it is enlarged or far from its origin.

    Args:
        flags: the format's flags.
        images: images of all splits.
        split: the split to read; only training reports.
        applied: the transform already applied to the poses, which a placement file does not include.

    Raises:
        DataError: if the placement file cannot be read.
    """
    placement = _placement(flags, images, split, applied)
    positions = placement.points(images.poses[:, :3, 3])
    if split == "train" and local_origin(positions, flags.scene_scale) is not None:
        say(
            f"cameras are so far from the scene's origin that float32 rounds positions by up to "
            f"{rounding(positions):.2g} scene units: --center-method poses moves the origin between them"
        )
    return placement


def _placement(flags: Captured, images: PosedImages, split: Split, applied: Applied | None) -> Placement:
    if flags.placement is not None:
        given = read_transforms(flags.placement)
        return given.after(*applied) if applied else given
    # A device measures gravity, and its images are upright.
    orientation = "up" if flags.orientation_method == "auto" and flags.poses == "device" else flags.orientation_method
    spread = camera_spread(images.poses, images.points if images.tracks is None else images.tracks.points)
    if spread is not None and spread < MIN_PARALLAX and split == "train" and images.model != "orthographic":
        say(warning(spread))
    if images.region is not None:
        rotation = place(images.poses, orientation, "none", False).transform[:, :3]
        transform = torch.cat([rotation, -(rotation @ images.region.center)[:, None]], -1)
        return Placement(transform, flags.scale_factor / float(images.region.half.max()))
    scaled = flags.auto_scale_poses and spread != 0  # distances of cameras in one position are rounding errors
    placement = place(images.poses, orientation, flags.center_method, scaled)
    if scaled and images.model != "orthographic":
        spreads = (images.sizes / images.intrinsics[:, :2]).amax(-1)
        factor = enlargement(placement.poses(images.poses), spreads)
        if factor > 1 and split == "train":
            say(f"cameras see a small scene from afar: it is enlarged by {factor:.1f} (--auto-scale-poses)")
        placement = replace(placement, scale=placement.scale * factor)
    return replace(placement, scale=placement.scale * flags.scale_factor)


def from_original(scene: ParsedScene, applied: Tensor, scale: float = 1.0) -> ParsedScene:
    """Return the scene with `transform` and `scale` relative to the original frame.

    Args:
        scene: a scene with `transform` and `scale` relative to the format's frame.
        applied: (4, 4) rigid transform from the original frame to the format's, applied before `scale`.
        scale: units of the format's frame per unit of the original: x becomes `scale * (applied @ x)`.
    """
    placement = scene.placement.before(applied, scale)
    return replace(scene, transform=placement.transform, scale=placement.scale)
