"""Pixels of a view that may show an occupied cell; all others show only the background."""

from __future__ import annotations

import torch
from torch import Tensor

from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.view import View, every
from nerfloom.geometry.bounds import cell_corners
from nerfloom.kernels.images.silhouettes import Photograph, pixels_under_balls
from nerfloom.samplers.base import Sampler
from nerfloom.samplers.occupancy import OccupancySampler

MIN_PIXELS = 2**14
"""Minimum number of pixels of a view; for smaller views the search saves no time over tracing all rays."""


def pixels_in_view(sampler: Sampler, view: View) -> Tensor | None:
    """Return the pixels of a view with rays that may meet an occupied cell, with a margin around them.

    Args:
        view: the view, on the sampler's device.

    Returns:
        (height, width) bool; None if unknown: for other samplers, unbounded grids, lens distortion, and small views.
    """
    camera, small = view.camera, view.height * view.width < MIN_PIXELS
    if type(sampler) is not OccupancySampler or sampler.levels > 1 or sampler.endless:
        return None
    if small or type(camera) is not Cameras or camera.model != "pinhole":
        return None
    slices, times = sampler.occupancy.slices_of(view.times()), sampler.occupied.view(sampler.slices, -1)
    n, (low, high) = sampler.resolution, sampler.box
    cells = times[0 if slices is None else int(slices[0])].nonzero().squeeze(-1)
    edges = (high - low) / n
    (height, width), (fx, fy, cx, cy) = camera.sizes[0], camera.intrinsics[0]
    nothing = cells.new_zeros(1, 1, dtype=torch.int32).expand(height + 1, width + 1)
    seen_by = Photograph(camera.camera_to_worlds[0], fx, fy, cx, cy, nothing)
    return every(
        pixels_under_balls(seen_by, low + (cell_corners(cells, n) + 0.5) * edges, float(edges.norm()) / 2), view.stride
    )
