"""The placement of a captured scene: up, origin and scale by its cameras."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from framework.base.console import say
from framework.cameras.poses import Placement, enlargement, place
from framework.data.dataset import Split

if TYPE_CHECKING:
    from dataparsers.captured import Captured, PosedImages


def placement_of(flags: Captured, images: PosedImages, split: Split) -> Placement:
    """Return the placement of the scene that all images show, and say if it is enlarged.

    Args:
        flags: the format's flags.
        images: images of all splits.
        split: the split that is read; training says what is unusual.
    """
    # A device knows where gravity pulls, and its images are upright.
    orientation = "up" if flags.orientation_method == "auto" and flags.poses == "device" else flags.orientation_method
    placement = place(images.poses, orientation, flags.center_method, flags.auto_scale_poses)
    if flags.auto_scale_poses and images.model != "orthographic":
        spreads = (images.sizes / images.intrinsics[:, :2]).amax(-1)
        precise = replace(placement, transform=placement.transform.double())
        factor = enlargement(precise.poses(images.poses.double()), spreads)
        if factor > 1 and split == "train":
            say(
                f"cameras look at something small from afar: the scene is enlarged by {factor:.1f} (--auto-scale-poses)"
            )
        placement = replace(placement, scale=placement.scale * factor)
    return replace(placement, scale=placement.scale * flags.scale_factor)
