"""Space that several training images show. Rays start there.

The content of a single image could be at any distance. Matter that only one camera sees, mostly right before it, is
usually wrong, and hides the scene behind it from other viewpoints. (Instant-NGP, Mueller et al. 2022, skips space that
no camera sees: `mark_untrained_density_grid` of the authors' code.)
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor, nn

from nerfloom.cameras.cameras import Cameras
from nerfloom.geometry.bounds import nested_boxes
from nerfloom.geometry.rays import Rays
from nerfloom.kernels.march.first_covisible import CELLS, LEVELS, first_covisible
from nerfloom.kernels.native import torch_on_one_thread

BLOCK = 4
"""Cells along an edge of the cubes that are tested first."""


class CovisibleSpace(nn.Module):
    """Space that enough images show, by nested boxes from `box` (2, 3); all of space until `exclude` is called."""

    box: Tensor
    excluded: Tensor
    """(L n^3 + 1,) bool, box by box; the last entry stands for all space beyond the boxes and is False."""

    def __init__(self, box: Tensor) -> None:
        super().__init__()
        self.register_buffer("box", box.clone(memory_format=torch.contiguous_format))
        self.register_buffer("excluded", torch.zeros(LEVELS * CELLS**3 + 1, dtype=torch.bool, device=box.device))

    def exclude(self, cameras: Cameras, nearest: Tensor, least: int) -> None:
        """Exclude cells that fewer than `least` images show, or fewer than all if there are fewer images.

        Args:
            cameras: M training cameras.
            nearest: (M,) distance of each camera that its image shows to be empty, scene units.
            least: minimum number of images, at least 1.
        """
        least = min(least, len(cameras))
        with torch_on_one_thread():  # the operations are small
            seen = [times_seen(cameras, nearest, box, CELLS, least) for box in nested_boxes(self.box, LEVELS)]
        self.excluded[:-1] = torch.cat(seen) < least

    def forward(self, rays: Rays) -> Rays:
        """Return `rays` from where they first meet space that enough images show; unchanged if they never do."""
        return replace(rays, nears=first_covisible(rays, self.box, self.excluded))


@torch.no_grad()
def share_cut_off(space: CovisibleSpace, rays: Rays, distances: Tensor) -> float:
    """Return the fraction of `rays` that would start in `space` behind their known `distances` (R,), scene units."""
    return float((space(rays).nears > distances).double().mean())


@torch.no_grad()
def times_seen(cameras: Cameras, nearest: Tensor, box: Tensor, resolution: int, most: int) -> Tensor:
    """Return the number of images that show each cell of a box, at most `most`.

    An image shows a cell if the whole ball around it is within the frame, because no ray may meet the part of a cell
    beyond the image's edge. The cell's centre must also be beyond the camera's nearest distance.

    Args:
        cameras, nearest: as in `CovisibleSpace.exclude`.
        box: (2, 3) minimum and maximum corner, scene units.
        resolution: number n of cells along each axis, a multiple of `BLOCK`.
        most: maximum count.

    Returns:
        (n^3,) uint8; the index of a cell is (x n + y) n + z.
    """
    side, edge = resolution // BLOCK, (box[1] - box[0]) / resolution
    cubes = torch.cartesian_prod(*[torch.arange(side, device=box.device)] * 3)
    within = torch.cartesian_prod(*[torch.arange(BLOCK, device=box.device)] * 3)
    centers = box[0] + (cubes[:, None] * BLOCK + within + 0.5) * edge
    middles, radius = box[0] + (cubes + 0.5) * BLOCK * edge, float(edge.norm()) / 2
    counts = torch.zeros(centers.shape[:2], dtype=torch.uint8, device=box.device)
    for index in range(len(cameras)):
        perhaps = _within(cameras, index, middles, BLOCK * radius) & (counts < most).any(1)
        some = perhaps.nonzero().squeeze(-1)
        tested = centers[some].view(-1, 3)
        beyond = (tested - cameras.camera_to_worlds[index, :, 3]).norm(dim=-1) > nearest[index]
        counts[some] += (_within(cameras, index, tested, -radius) & beyond).view(-1, BLOCK**3)
    return counts.view(side, side, side, BLOCK, BLOCK, BLOCK).permute(0, 3, 1, 4, 2, 5).reshape(-1).clamp(max=most)


def _within(cameras: Cameras, index: int, centers: Tensor, margin: float) -> Tensor:
    """Return whether balls or parts of balls around `centers` (N, 3) are within one camera's image, (N,) bool.

    A ball at the angle a from the axis is 1 + tan(a)^2 times as large in a planar image as in the image's centre.

    Args:
        cameras: M cameras.
        index: index of the camera.
        centers: centres of the balls.
        margin: radius of the balls, scene units. If positive, a part of a ball within the image suffices; if negative,
            the whole ball must be within.
    """
    distances = (centers - cameras.camera_to_worlds[index, :, 3]).norm(dim=-1)
    columns, rows, ahead = cameras.project(centers, index)
    cx, cy, width, height = (values[index] for values in (cameras.cx, cameras.cy, cameras.widths, cameras.heights))
    focal = torch.maximum(cameras.fx[index], cameras.fy[index])
    corner = (torch.maximum(cx, width - cx).square() + torch.maximum(cy, height - cy).square()) / focal.square()
    tangent = ((columns - cx).square() + (rows - cy).square()) / focal.square()
    reach = (1 + torch.minimum(tangent, corner)) * focal * margin / distances.clamp(min=abs(margin))
    inside = ahead & (columns > -reach) & (columns < width + reach)
    return inside & (rows > -reach) & (rows < height + reach) | (distances < margin)
