"""What transparent photographs say before anything is trained: the visual hull (Laurentini 1994).

A point of the scene that some photograph shows as fully transparent is empty. So a cell of space whose image in one
photograph holds no opaque pixel can be skipped for good, and so can the pixels whose ray meets no other cell.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from framework.data.dataset import Dataset
from framework.data.pixel_set import PixelSet
from framework.kernels.silhouettes import Photograph, hold_balls, opaque_sums, pixels_near_balls

COARSEST = 8
"""Cells along an edge of the cubes that are looked at first."""


class _Counts(Sequence[Tensor]):
    """The sums of a data set's photographs, of which only the last that was asked for is remembered."""

    def __init__(self, dataset: Dataset) -> None:
        self._dataset, self._last = dataset, (-1, torch.empty(0))

    def __len__(self) -> int:
        return len(self._dataset)

    def __getitem__(self, image: Any) -> Any:
        if not 0 <= image < len(self):
            raise IndexError(image)
        if self._last[0] != image:
            opaque, kept = self._dataset.image(image)[..., 3] > 0, self._dataset.kept_of(image)
            if kept is not None:
                opaque |= ~kept  # who knows what is there
            self._last = image, opaque_sums(opaque)
        return self._last[1]


@dataclass(frozen=True)
class Silhouettes:
    """Which pixels of M photographs are not fully transparent."""

    dataset: Dataset
    """Photographs with alpha, through pinhole cameras."""
    sums: Sequence[Tensor]
    """M tensors (H + 1, W + 1) int32: how many such pixels lie above and left of a pixel's corner."""

    @classmethod
    def of(cls, dataset: Dataset) -> Silhouettes:
        """Count every photograph once, so that any square of pixels is four look-ups.

        Where the photographs are too many for memory, so are the counts: each is then made when it is asked for.
        """
        counts = _Counts(dataset)
        return cls(dataset, counts if dataset.mapped is not None else tuple(counts))

    def __len__(self) -> int:
        return len(self.sums)

    def photograph(self, image: int) -> Photograph:
        """A photograph's camera and sums."""
        cameras = self.dataset.cameras
        fx, fy, cx, cy = (float(values[image]) for values in (cameras.fx, cameras.fy, cameras.cx, cameras.cy))
        return Photograph(cameras.camera_to_worlds[image].contiguous(), fx, fy, cx, cy, self.sums[image])


@torch.no_grad()
def visual_hull(silhouettes: Silhouettes, box: Tensor, resolution: int, moving: bool = False) -> Tensor:
    """Cells of a box that no photograph shows to be empty, from coarse to fine.

    Of a scene that moves, cells are dropped that every photograph shows to be empty, and whose neighbours are too: the
    margin is for what moves between the times of the photographs.

    Args:
        silhouettes: of the training photographs.
        box: (2, 3).
        resolution: n, cells along each axis.
        moving: what one photograph shows to be empty may be full at another's time.
    Returns: (n^3,) bool, the cell's index being (x n + y) n + z.
    """
    size = min(COARSEST, 1 << (resolution - 1).bit_length())
    count = -(-resolution // size)
    cubes = torch.cartesian_prod(*[torch.arange(count, device=box.device)] * 3) * size
    while True:
        low = box[0] + (box[1] - box[0]) * cubes / resolution
        edge = (box[1] - box[0]) * size / resolution
        centers, radius = (low + edge / 2).contiguous(), float(edge.norm()) / 2
        held = torch.full((len(cubes),), not moving, device=box.device)
        for image in range(len(silhouettes)):
            hold_balls(silhouettes.photograph(image), centers, radius, held, every=not moving)
        cubes = cubes[held]
        if size == 1:
            break
        size //= 2
        corners = torch.cartesian_prod(*[torch.tensor([0, size], device=box.device)] * 3)
        cubes = (cubes[:, None] + corners).reshape(-1, 3)
        cubes = cubes[(cubes < resolution).all(-1)]
    hull = torch.zeros(resolution**3, dtype=torch.bool, device=box.device)
    hull[(cubes[:, 0] * resolution + cubes[:, 1]) * resolution + cubes[:, 2]] = True
    if moving:
        grid = hull.view(1, 1, resolution, resolution, resolution).float()
        hull = functional.max_pool3d(grid, 3, stride=1, padding=1).view(-1) > 0
    return hull


@torch.no_grad()
def pixels_near(silhouettes: Silhouettes, hull: Tensor, box: Tensor, resolution: int) -> PixelSet:
    """Pixels, counted through all photographs, that may see a cell of the hull. Other rays see background alone."""
    cells = hull.nonzero().squeeze(-1)
    corner = torch.stack([cells // resolution**2, cells // resolution % resolution, cells % resolution], dim=-1)
    centers = box[0] + (corner + 0.5) * (box[1] - box[0]) / resolution
    radius = float(((box[1] - box[0]) / resolution).norm()) / 2
    chosen = []
    for image in range(len(silhouettes)):
        near = pixels_near_balls(silhouettes.photograph(image), centers, radius)
        chosen.append(PixelSet.of_mask(near, int(silhouettes.dataset.cameras.offsets[image])))
    return PixelSet.joined(chosen)
