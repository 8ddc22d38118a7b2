"""Free space before cameras: nearer than everything an image is known to show, or than a second image can see.

Matter right before a camera is seen by that camera alone. It can take any appearance that fits the camera's image, and
blocks every other view.
"""

from __future__ import annotations

import torch
from torch import Tensor

from nerfloom.base.evenly_spaced import evenly_spaced
from nerfloom.cameras.cameras import Cameras
from nerfloom.data.sparse_depth import SparseDepth

CLEAR_SHARE = 0.7
"""Space up to this fraction of the distance of a camera's nearest points counts as empty."""
WRONG_SHARE = 0.02
"""Fraction of a camera's points that may be nearer than its "nearest" points, since a few points are always wrong."""
MIN_POINTS = 10
"""Minimum number of points of a camera for an estimate."""
RAYS, STEPS = 8, 24
"""Number of rays along each side of an image, and of distances along a ray, tested for visibility in other cameras."""
MAX_CAMERAS = 64
"""Maximum number of other cameras tested."""
MAX_DISTANCE = 2.0
"""Maximum distance of space that counts as empty because no other camera sees it, scene units."""
MAX_SEEN_SHARE = 0.1
"""Maximum fraction of an image's rays that another camera may see where the image counts as alone."""


@torch.no_grad()
def clear_distances(cameras: Cameras, known: SparseDepth | None, near: float, far: float) -> Tensor:
    """Return the length (M,) of the space in front of each camera that is known to be empty.

    Args:
        cameras: M training cameras.
        known: pixels of their images with known distance; None if there are none.
        near, far: ends of the scene's rays, scene units.
    """
    alone = distances_alone(cameras, near, min(far, MAX_DISTANCE))
    return alone if known is None else torch.maximum(alone, before_points(cameras, known))


def before_points(cameras: Cameras, known: SparseDepth) -> Tensor:
    """Return `CLEAR_SHARE` of the distance (M,) of the nearest points in each image; 0 for images with too few points.

    Args:
        cameras: M cameras.
        known: pixels of their images with known distance.
    """
    images = torch.searchsorted(cameras.offsets, known.pixels, right=True) - 1
    counts = torch.bincount(images, minlength=len(cameras))
    # Sorted by image and, within an image, by distance.
    order = known.distances.argsort(stable=True)
    order = order[images[order].argsort(stable=True)]
    enough = counts >= MIN_POINTS
    ranks = (counts.cumsum(0) - counts + (WRONG_SHARE * counts).long())[enough]
    nearest = known.distances.new_zeros(len(cameras))
    nearest[enough] = known.distances[order[ranks]]
    return CLEAR_SHARE * nearest


def distances_alone(cameras: Cameras, near: float, far: float) -> Tensor:
    """Return the distance (M,) from each camera that no other camera sees.

    For a single camera it is 0: no other camera sees anything, which says nothing about the space.

    Args:
        cameras: M cameras.
        near, far: minimum and maximum distance tested, scene units.
    """
    device = cameras.fx.device
    if len(cameras) == 1:
        return torch.zeros(1, device=device)
    steps = torch.linspace(near, far, STEPS, device=device)
    across = (torch.arange(RAYS, device=device) + 0.5) / RAYS
    asked = evenly_spaced(len(cameras), MAX_CAMERAS).to(device)
    found = torch.zeros(len(cameras), device=device)
    for index in range(len(cameras)):
        columns = (across * cameras.widths[index] - 0.5).repeat(RAYS)
        rows = (across * cameras.heights[index] - 0.5).repeat_interleave(RAYS)
        rays = cameras.rays(torch.full_like(rows, index, dtype=torch.int64), columns, rows, near, far)
        points = (rays.origins[:, None] + rays.directions[:, None] * steps[:, None]).view(-1, 3)
        others = asked[asked != index]
        seeing = others.repeat_interleave(len(points))
        left, top, ahead = cameras.project(points.repeat(len(others), 1), seeing)
        inside = ahead & (left >= 0) & (left < cameras.widths[seeing]) & (top >= 0) & (top < cameras.heights[seeing])
        shared = inside.view(len(others), RAYS * RAYS, STEPS).any(0).float().mean(0) > MAX_SEEN_SHARE
        alone = int(shared.int().argmax()) if bool(shared.any()) else STEPS
        found[index] = steps[alone - 1] if alone > 0 else 0.0
    return found
