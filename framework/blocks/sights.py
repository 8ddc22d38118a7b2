"""Labels for the visibility network of a block: the points that its training images see, and from where."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from nerfloom.cameras.cameras import Cameras

SURFACE = 1.05
"""A point up to this multiple of a surface's distance counts as in front of it."""
SIMILAR = math.cos(math.radians(20))
"""Minimum cosine of the angle between two directions towards a point if it looks alike from both."""
NEAREST, FARTHEST = 0.02, 2.0
"""Range of the distances of points from the cameras that look at them, in radii of the block."""
SCATTER = 0.1
"""Standard deviation of those cameras from training cameras, in radii of the block."""


@dataclass(frozen=True)
class Sights:
    """Small pictures of some training images. All tensors are on the CPU, all lengths in units of the block's scene."""

    cameras: Cameras
    """Their M cameras, as they stand in the data."""
    depths: Sequence[Tensor]
    """(h, w) median distances of each picture."""
    opacities: Sequence[Tensor]
    """(h, w) opacities of each picture."""
    strides: Sequence[int]
    """Distance between the rows and columns of each picture, pixels of the image."""

    def transmittance(self, points: Tensor, directions: Tensor) -> Tensor:
        """Return the transmittance (N,) of points, the largest among images that see them from about a direction.

        It is 1 in front of a surface, and one minus the opacity behind it. It is 0 where no image looks.

        Args:
            points: (N, 3) positions.
            directions: (N, 3) unit directions from a camera to each point.
        """
        found = torch.zeros(len(points))
        for number in range(len(self.cameras)):
            found = torch.maximum(found, self._of_image(number, points, directions))
        return found

    def _of_image(self, number: int, points: Tensor, directions: Tensor) -> Tensor:
        depths, opacities, stride = self.depths[number], self.opacities[number], self.strides[number]
        height, width = depths.shape
        columns, rows, ahead = self.cameras.project(points, number)
        column, row = (((values - stride // 2) / stride).round().long() for values in (columns, rows))
        shown = ahead & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        away = points - self.cameras.camera_to_worlds[number, :, 3]
        distance = away.norm(dim=-1)
        similar = (away * directions).sum(-1) >= SIMILAR * distance
        at = row.clamp(0, height - 1) * width + column.clamp(0, width - 1)
        behind = distance > SURFACE * depths.flatten()[at]
        through = torch.where(behind, 1 - opacities.flatten()[at], 1.0)
        return torch.where(shown & similar, through, 0.0)


def queries(cameras: Cameras, radius: float, count: int) -> tuple[Tensor, Tensor]:
    """Return points to learn from, (N, 3), and directions towards them, (N, 3); N is about `count`.

    They are seen from places near training cameras, one half in directions of training images, the other half in any
    direction. Distances are distributed evenly by their logarithm.

    Args:
        cameras: M training cameras on the CPU, M at least 1.
        radius: the block's radius, in units of its scene.
        count: number of points.
    """
    random = torch.Generator().manual_seed(0)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=random)

    which = torch.randint(len(cameras), (count,), generator=random)
    columns, rows = (uniform(count) * sizes[which] - 0.5 for sizes in (cameras.widths, cameras.heights))
    of_images = cameras.rays(which, columns, rows, 0.0, 1.0).directions
    anywhere = torch.nn.functional.normalize(torch.randn(count, 3, generator=random), dim=-1)
    directions = torch.where(uniform(count, 1) < 0.5, of_images, anywhere)
    places = cameras.camera_to_worlds[which, :, 3] + SCATTER * radius * torch.randn(count, 3, generator=random)
    low, high = math.log(NEAREST * radius), math.log(FARTHEST * radius)
    points = places + torch.exp(low + (high - low) * uniform(count, 1)) * directions
    valid = directions.isfinite().all(-1)
    return points[valid], directions[valid]
