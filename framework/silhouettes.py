"""What transparent photographs say before anything is trained: the visual hull (Laurentini 1994).

A point of the scene that some photograph shows as fully transparent is empty. So a cell of space whose image in one
photograph holds no opaque pixel can be skipped for good, and so can the pixels whose ray meets no other cell.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from framework.dataset import Dataset

COARSEST = 8
"""Cells along an edge of the cubes that are looked at first."""


@dataclass(frozen=True)
class Silhouettes:
    """Which pixels of M photographs are not fully transparent."""

    dataset: Dataset
    """Photographs with alpha, through pinhole cameras."""
    sums: tuple[Tensor, ...]
    """M tensors (H + 1, W + 1) int32: how many such pixels lie above and left of a pixel's corner."""

    @classmethod
    def of(cls, dataset: Dataset) -> Silhouettes:
        """Count every photograph once, so that any square of pixels is four look-ups."""
        sums = []
        for index in range(len(dataset)):
            opaque = (dataset.image(index)[..., 3] > 0).to(torch.int32)
            sums.append(functional.pad(opaque.cumsum(0, dtype=torch.int32).cumsum(1, dtype=torch.int32), (1, 0, 1, 0)))
        return cls(dataset, tuple(sums))

    def depth(self, image: int, points: Tensor) -> Tensor:
        """Distance (N,) of points (N, 3) along the camera's axis."""
        pose = self.dataset.cameras.camera_to_worlds[image]
        return (pose[:, 3] @ pose[:, 2]) - points @ pose[:, 2]  # the camera looks down its -z

    def may_hold(self, image: int, centers: Tensor, radius: float) -> Tensor:
        """(N,) bool: False where the photograph shows the ball of `radius` around a centre whole, and nothing in it."""
        cameras = self.dataset.cameras
        pose = cameras.camera_to_worlds[image]
        depth = self.depth(image, centers)
        nearest = depth - radius
        safe = nearest.clamp(min=1e-6)
        local = (centers - pose[:, 3]) @ pose[:, :2]
        fx, fy, cx, cy = (float(values[image]) for values in (cameras.fx, cameras.fy, cameras.cx, cameras.cy))
        column, row = cx + fx * local[:, 0] / depth, cy - fy * local[:, 1] / depth
        # A ball at an angle to the axis is seen as an ellipse, at most 1 / cos^2 as long as its height is wide.
        slant = 1 + (local / safe[:, None]).square().sum(-1)
        reach = radius / safe * max(fx, fy) * slant + 1  # an edge is known to a pixel
        height, width = self.sums[image].shape[0] - 1, self.sums[image].shape[1] - 1
        left, right = (column - reach).floor(), (column + reach).ceil()
        top, bottom = (row - reach).floor(), (row + reach).ceil()
        shown = (nearest > 0) & (left >= 0) & (top >= 0) & (right <= width) & (bottom <= height)
        x0, x1 = (x.nan_to_num().clamp(0, width).long() for x in (left, right))
        y0, y1 = (y.nan_to_num().clamp(0, height).long() for y in (top, bottom))
        flat, stride = self.sums[image].view(-1), width + 1
        count = flat[y1 * stride + x1] - flat[y1 * stride + x0] - flat[y0 * stride + x1] + flat[y0 * stride + x0]
        return ~shown | (count > 0)


@torch.no_grad()
def visual_hull(silhouettes: Silhouettes, box: Tensor, resolution: int) -> Tensor:
    """Cells of a box that no photograph shows to be empty, from coarse to fine.

    Args:
        silhouettes: of the training photographs.
        box: (2, 3).
        resolution: n, cells along each axis.
    Returns: (n^3,) bool, the cell's index being (x n + y) n + z.
    """
    size = min(COARSEST, 1 << (resolution - 1).bit_length())
    count = -(-resolution // size)
    cubes = torch.cartesian_prod(*[torch.arange(count, device=box.device)] * 3) * size
    while True:
        low = box[0] + (box[1] - box[0]) * cubes / resolution
        edge = (box[1] - box[0]) * size / resolution
        centers, radius = low + edge / 2, float(edge.norm()) / 2
        for image in range(len(silhouettes.sums)):
            keep = silhouettes.may_hold(image, centers, radius)
            centers, cubes = centers[keep], cubes[keep]
        if size == 1:
            break
        size //= 2
        corners = torch.cartesian_prod(*[torch.tensor([0, size], device=box.device)] * 3)
        cubes = (cubes[:, None] + corners).reshape(-1, 3)
        cubes = cubes[(cubes < resolution).all(-1)]
    hull = torch.zeros(resolution**3, dtype=torch.bool, device=box.device)
    hull[(cubes[:, 0] * resolution + cubes[:, 1]) * resolution + cubes[:, 2]] = True
    return hull


@torch.no_grad()
def pixels_near(silhouettes: Silhouettes, hull: Tensor, box: Tensor, resolution: int) -> Tensor:
    """Pixels (K,) int64, counted through all photographs, that may see a cell of the hull.

    A cell of the hull has an opaque pixel within the reach of its image, and a ray that meets the cell lies within
    that reach too: so twice the largest reach around a silhouette is enough. Other rays see background alone.
    """
    cells = hull.nonzero().squeeze(-1)
    corner = torch.stack([cells // resolution**2, cells // resolution % resolution, cells % resolution], dim=-1)
    centers = box[0] + (corner + 0.5) * (box[1] - box[0]) / resolution
    radius = float(((box[1] - box[0]) / resolution).norm()) / 2
    cameras, chosen = silhouettes.dataset.cameras, []
    for image, sums in enumerate(silhouettes.sums):
        height, width = sums.shape[0] - 1, sums.shape[1] - 1
        focal = max(float(cameras.fx[image]), float(cameras.fy[image]))
        nearest = float(silhouettes.depth(image, centers).min()) - radius if len(centers) else 1.0
        slant = 1 + ((width / 2) ** 2 + (height / 2) ** 2) / focal**2
        reach = int(2 * radius / nearest * focal * slant) + 5 if nearest > 0 else max(height, width)
        rows, columns = torch.arange(height, device=box.device), torch.arange(width, device=box.device)
        top, bottom = (rows - reach).clamp(min=0), (rows + reach + 1).clamp(max=height)
        left, right = (columns - reach).clamp(min=0), (columns + reach + 1).clamp(max=width)
        band = sums[bottom] - sums[top]
        near = band[:, right] - band[:, left] > 0
        chosen.append(near.reshape(-1).nonzero().squeeze(-1) + silhouettes.dataset.offsets[image])
    return torch.cat(chosen)
