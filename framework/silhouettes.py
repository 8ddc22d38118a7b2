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

from framework.dataset import Dataset
from framework.pixel_set import PixelSet

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
            seen, kept = self._dataset.image(image)[..., 3] > 0, self._dataset.kept_of(image)
            if kept is not None:
                seen |= ~kept  # who knows what is there
            sums = seen.to(torch.int32).cumsum(0, dtype=torch.int32).cumsum(1, dtype=torch.int32)
            self._last = image, functional.pad(sums, (1, 0, 1, 0))
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

    def depth(self, image: int, points: Tensor) -> Tensor:
        """Distance (N,) of points (N, 3) along the camera's axis."""
        pose = self.dataset.cameras.camera_to_worlds[image]
        return (pose[:, 3] @ pose[:, 2]) - points @ pose[:, 2]  # the camera looks down its -z

    def footprint(self, image: int, centers: Tensor, radius: float) -> tuple[Tensor, Tensor]:
        """Where a photograph shows balls of `radius` around centers (N, 3), to a pixel more on each side.

        Returns: left, right, top, bottom (4, N) in pixels' corners, clamped to the photograph; and (N,) bool whether
            the ball lies in it whole, in front of the camera.
        """
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
        edges = torch.stack(
            [(column - reach).floor(), (column + reach).ceil(), (row - reach).floor(), (row + reach).ceil()]
        )
        height, width = self.sums[image].shape[0] - 1, self.sums[image].shape[1] - 1
        limits = torch.tensor([[width], [width], [height], [height]], device=edges.device)
        whole = (nearest > 0) & (edges >= 0).all(0) & (edges <= limits).all(0)
        return torch.minimum(edges.nan_to_num().clamp(min=0), limits).long(), whole

    def may_hold(self, image: int, centers: Tensor, radius: float) -> Tensor:
        """(N,) bool: False where the photograph shows the ball of `radius` around a centre whole, and nothing in it."""
        (x0, x1, y0, y1), whole = self.footprint(image, centers, radius)
        flat, stride = self.sums[image].view(-1), self.sums[image].shape[1]
        count = flat[y1 * stride + x1] - flat[y1 * stride + x0] - flat[y0 * stride + x1] + flat[y0 * stride + x0]
        return ~whole | (count > 0)


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
        centers, radius = low + edge / 2, float(edge.norm()) / 2
        if moving:
            keep = _ever_held(silhouettes, centers, radius)
            centers, cubes = centers[keep], cubes[keep]
        else:
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
    if moving:
        grid = hull.view(1, 1, resolution, resolution, resolution).float()
        hull = functional.max_pool3d(grid, 3, stride=1, padding=1).view(-1) > 0
    return hull


def _ever_held(silhouettes: Silhouettes, centers: Tensor, radius: float) -> Tensor:
    """(N,) bool: balls that some photograph does not show to be empty."""
    held = torch.zeros(len(centers), dtype=torch.bool, device=centers.device)
    for image in range(len(silhouettes.sums)):
        rest = (~held).nonzero().squeeze(-1)
        held[rest] = silhouettes.may_hold(image, centers[rest], radius)
    return held


@torch.no_grad()
def pixels_near(silhouettes: Silhouettes, hull: Tensor, box: Tensor, resolution: int) -> PixelSet:
    """Pixels, counted through all photographs, that may see a cell of the hull.

    A cell of the hull that a photograph shows whole has an opaque pixel within the reach of its image, and a ray that
    meets the cell lies within that reach too: so twice the largest reach around a silhouette is enough. Of cells that
    stick out of the photograph, every pixel that may see them is taken. Other rays see background alone.
    """
    cells = hull.nonzero().squeeze(-1)
    corner = torch.stack([cells // resolution**2, cells // resolution % resolution, cells % resolution], dim=-1)
    centers = box[0] + (corner + 0.5) * (box[1] - box[0]) / resolution
    radius = float(((box[1] - box[0]) / resolution).norm()) / 2
    chosen = []
    for image in range(len(silhouettes.sums)):
        near = _near(silhouettes, image, centers, radius) | _under_cut_cells(silhouettes, image, centers, radius)
        chosen.append(PixelSet.of_mask(near, int(silhouettes.dataset.cameras.offsets[image])))
    return PixelSet.joined(chosen)


def _near(silhouettes: Silhouettes, image: int, centers: Tensor, radius: float) -> Tensor:
    """(H, W) bool: within twice the largest reach of a ball of an opaque pixel."""
    sums, cameras = silhouettes.sums[image], silhouettes.dataset.cameras
    height, width = sums.shape[0] - 1, sums.shape[1] - 1
    focal = max(float(cameras.fx[image]), float(cameras.fy[image]))
    nearest = float(silhouettes.depth(image, centers).min()) - radius if len(centers) else 1.0
    slant = 1 + ((width / 2) ** 2 + (height / 2) ** 2) / focal**2
    reach = int(2 * radius / nearest * focal * slant) + 5 if nearest > 0 else max(height, width)
    rows, columns = (torch.arange(n, device=sums.device) for n in (height, width))
    top, bottom = (rows - reach).clamp(min=0), (rows + reach + 1).clamp(max=height)
    left, right = (columns - reach).clamp(min=0), (columns + reach + 1).clamp(max=width)
    band = sums[bottom] - sums[top]
    return band[:, right] - band[:, left] > 0


def _under_cut_cells(silhouettes: Silhouettes, image: int, centers: Tensor, radius: float) -> Tensor:
    """(H, W) bool: pixels that may see a ball which the photograph does not show whole."""
    (x0, x1, y0, y1), whole = silhouettes.footprint(image, centers, radius)
    depth = silhouettes.depth(image, centers)
    cut = ~whole & (x1 > x0) & (y1 > y0) & (depth > -radius)
    height, width = (n - 1 for n in silhouettes.sums[image].shape)
    if bool((cut & (depth <= radius)).any()):  # the camera stands within the ball
        return torch.ones(height, width, dtype=torch.bool, device=centers.device)
    marks = torch.zeros((height + 1) * (width + 1), dtype=torch.int32, device=centers.device)
    ones = torch.ones(int(cut.sum()), dtype=torch.int32, device=centers.device)
    for x, y, sign in ((x0, y0, 1), (x1, y0, -1), (x0, y1, -1), (x1, y1, 1)):
        marks.index_add_(0, (y * (width + 1) + x)[cut], ones * sign)
    count = marks.view(height + 1, width + 1).cumsum(0).cumsum(1)
    return count[:height, :width] > 0
