"""Cells of space that at least one image shows; matter in other cells cannot be learned and would only be in the way.

Instant-NGP skips cells that no training camera sees (Mueller et al. 2022, `mark_untrained_density_grid` of the authors'
code). Here, space right before a camera, nearer than the points its image shows, does not count as shown.
"""

from __future__ import annotations

import torch
from torch import Tensor

from nerfloom.cameras.cameras import Cameras

BLOCK = 4
"""Cells along an edge of the cubes that are tested together."""
SURELY_SEEN_DISTANCE = 4
"""A camera within this distance, in radii of a cube, is assumed to see it in any viewing direction."""
MIN_MARGIN = 2.0
"""Minimum factor for a cube's radius in the image; objects off the image centre appear larger."""


@torch.no_grad()
def seen_cells(cameras: Cameras, nearest: Tensor, box: Tensor, resolution: int) -> Tensor:
    """Return the cells of a box that some image shows, beyond that camera's nearest distance.

    Cells are tested in cubes of `BLOCK`, by their bounding balls. The result may have too many cells, never too few.

    Args:
        cameras: M cameras.
        nearest: (M,) distance of each camera that its image shows to be empty, scene units.
        box: (2, 3) minimum and maximum corner.
        resolution: number n of cells along each axis, a multiple of `BLOCK`.

    Returns:
        (n^3,) bool; the index of a cell is (x n + y) n + z.
    """
    side = resolution // BLOCK
    edge = (box[1] - box[0]) / side
    cubes = torch.cartesian_prod(*[torch.arange(side, device=box.device)] * 3)
    centers, radius = box[0] + (cubes + 0.5) * edge, float(edge.norm()) / 2
    seen = torch.zeros(len(cubes), dtype=torch.bool, device=box.device)
    for index in range(len(cameras)):
        left = (~seen).nonzero().squeeze(-1)
        seen[left] = _shows(cameras, index, centers[left], radius, nearest[index])
    return seen.view(side, 1, side, 1, side, 1).expand(-1, BLOCK, -1, BLOCK, -1, BLOCK).reshape(-1)


def _shows(cameras: Cameras, index: int, centers: Tensor, radius: float, nearest: Tensor) -> Tensor:
    """Return whether camera `index` may show a part of each ball around `centers` (N, 3), (N,) bool."""
    distances = (centers - cameras.camera_to_worlds[index, :, 3]).norm(dim=-1)
    columns, rows, ahead = cameras.project(centers, index)
    focal = torch.maximum(cameras.fx[index], cameras.fy[index])
    reach = _margin(cameras, index) * focal * radius / (distances - radius).clamp(min=radius)
    across = (columns > -reach) & (columns < cameras.widths[index] + reach)
    inside = ahead & across & (rows > -reach) & (rows < cameras.heights[index] + reach)
    return (inside | (distances < SURELY_SEEN_DISTANCE * radius)) & (distances + radius > nearest)


def _margin(cameras: Cameras, index: int) -> float:
    """Return how much larger a small ball appears in a corner of the image than in its centre, at least `MIN_MARGIN`.

    The factor is 1 + tan(a)^2 at the angle a from the axis, along the line to the centre.
    """
    one = cameras[index : index + 1]
    across, down = (
        float(torch.maximum(middle, size - middle)) / float(focal)
        for middle, size, focal in ((one.cx, one.widths, one.fx), (one.cy, one.heights, one.fy))
    )
    return max(MIN_MARGIN, 1 + across**2 + down**2)
