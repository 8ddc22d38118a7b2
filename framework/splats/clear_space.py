"""Space right before training cameras, where nothing can be: it would hide what the cameras see.

Gaussians there were fog of the field that they started from. They are outside the images of the camera itself, or
transparent in them, but hide the views of cameras beside it.
"""

from __future__ import annotations

import torch
from torch import Tensor

from nerfloom.base.evenly_spaced import evenly_spaced

NEAREST, CLEAR = 0.05, 0.4
"""Space is clear up to the second number times the distance that the first number of a camera's pixels is below. In the
procedural courtyard no visible surface is in such space, and some are from 0.5 on."""
MAX_CAMERAS = 200
"""Maximum number of cameras that are tested, evenly spaced."""
TESTED_AT_ONCE = 2**16
"""Number of points that are tested together, to limit memory."""


def clear_radii(images: Tensor, distances: Tensor, count: int) -> Tensor:
    """Return the radius (M,) of the clear space of each camera, scene units; 0 if nothing is known about it.

    Args:
        images: (K,) int64 camera of each known distance.
        distances: (K,) distances from these cameras, scene units.
        count: number M of cameras.
    """
    known = torch.bincount(images, minlength=count)
    if not len(images):
        return distances.new_zeros(count)
    order = distances.argsort()
    order = order[images[order].argsort(stable=True)]  # by camera, and by distance within each
    nearest = known.cumsum(0) - known + (NEAREST * known).long()
    return torch.where(known > 0, CLEAR * distances[order][nearest.clamp(max=len(order) - 1)], 0)


def in_clear_space(points: Tensor, poses: Tensor, radii: Tensor) -> Tensor:
    """Return which points lie in the half ball before a camera, (N,) bool.

    Args:
        points: (N, 3) scene coordinates.
        poses: (M, 3, 4) camera-to-scene poses.
        radii: (M,) radius of each half ball, scene units; cameras with 0 are left out.
    """
    known = (radii > 0).nonzero()[:, 0]
    known = known[evenly_spaced(len(known), MAX_CAMERAS).to(known.device)]
    centers, ahead, reach = poses[known, :, 3], -poses[known, :, 2], radii[known]
    found = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    if not len(known):
        return found
    for first in range(0, len(points), TESTED_AT_ONCE):
        some = points[first : first + TESTED_AT_ONCE]
        near = torch.cdist(some, centers, compute_mode="donot_use_mm_for_euclid_dist") < reach
        before = some @ ahead.T > (centers * ahead).sum(-1)
        found[first : first + TESTED_AT_ONCE] = (near & before).any(1)
    return found
