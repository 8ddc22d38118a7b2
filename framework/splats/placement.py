"""The frame of Gaussians without images: their place, size and up direction."""

from __future__ import annotations

from typing import Literal, get_args

import torch
from torch import Tensor

from nerfloom.base.errors import DataError
from nerfloom.cameras.poses import NEAR, UP, Placement, rotation_between
from nerfloom.data.scene import Scene
from nerfloom.splats.gaussians import Gaussians

Axis = Literal["x", "y", "z", "-x", "-y", "-z"]
"""An axis of a file's frame, and its direction."""
FAINT = 0.1
"""Gaussians below this opacity are ignored when the scene is placed."""
HALF_WITHIN = 0.5
"""Median distance of placed Gaussians from the origin, scene units."""
OUTSIDE = 0.01
"""A scene counts as unbounded if more than this share of the Gaussians is farther than 1 from the origin."""
IMAGE_SIZE = 800
"""Longer side of rendered pictures, pixels."""


def direction_of(axis: Axis) -> Tensor:
    """Return the unit vector (3,) float64 of an `axis`."""
    direction = torch.zeros(3, dtype=torch.float64)
    direction[get_args(Axis).index(axis) % 3] = -1.0 if axis.startswith("-") else 1.0
    return direction


def placed_gaussians(gaussians: Gaussians, up: Tensor = UP) -> tuple[Placement, Scene]:
    """Return the placement of Gaussians without images, and their scene.

    The median of the centres becomes the origin, and half of the Gaussians are then within `HALF_WITHIN` of it. Medians
    ignore the few that are far away; faint Gaussians do not count.

    Args:
        gaussians: N Gaussians in the frame of their file.
        up: (3,) float64 direction in that frame that becomes +z.

    Returns:
        The placement of the file's frame in the scene's, and a scene without cameras and with a box from -1 to 1. It is
        unbounded, with a black background, if more than `OUTSIDE` of the Gaussians are farther than 1 from the origin.

    Raises:
        DataError: if no Gaussian is finite.
    """
    finite = gaussians[gaussians.finite()]
    if not len(finite):
        raise DataError("the file has no Gaussian with finite numbers: export it again")
    dense = finite[torch.sigmoid(finite.logits) >= FAINT]
    means = (dense if len(dense) else finite).means.double().cpu()
    middle = means.median(0).values
    distances = (means - middle).norm(dim=-1)
    half = float(distances.median()) or finite.typical_size or 1.0
    scale = HALF_WITHIN / half
    rotation = rotation_between(up, UP)
    placement = Placement(torch.cat([rotation, -(rotation @ middle)[:, None]], dim=-1), scale)
    bounded = float((scale * distances > 1).double().mean()) <= OUTSIDE
    scene = Scene(
        box=torch.tensor([[-1.0] * 3, [1.0] * 3]),
        near=NEAR,
        far=10 + 2 * scale * float(distances.max()),
        num_cameras=0,
        has_alpha=bounded,
        moving=False,
        image_size=IMAGE_SIZE,
        unbounded=not bounded,
        z_is_up=True,
        poses="exact",
    )
    return placement, scene
