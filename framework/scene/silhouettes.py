"""Visual hulls (Laurentini 1994): space that transparent images show to be empty before training.

A point that is fully transparent in some image is empty. Therefore a cell of space whose projection into one image has
no opaque pixel can be skipped for good, and so can the pixels whose ray meets no other cell.
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
"""Maximum side of the first cubes tested, cells."""


class _Counts(Sequence[Tensor]):
    """The cumulative sums of a data set's images, of which only the last requested is kept in memory."""

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
                opaque |= ~kept  # nothing is known about these
            self._last = image, opaque_sums(opaque)
        return self._last[1]


@dataclass(frozen=True)
class Silhouettes:
    """The pixels of M images that are not fully transparent."""

    dataset: Dataset
    """Images with alpha, and pinhole cameras."""
    sums: Sequence[Tensor]
    """M tensors (H + 1, W + 1) int32: number of such pixels above and to the left of a pixel's corner."""

    @classmethod
    def of(cls, dataset: Dataset) -> Silhouettes:
        """Sum up each image of `dataset`, so that the count in any rectangle of pixels takes four look-ups.

        If the images exceed the memory limit, so do the sums; they are then computed each time they are requested.
        """
        counts = _Counts(dataset)
        return cls(dataset, counts if dataset.mapped is not None else tuple(counts))

    def __len__(self) -> int:
        return len(self.sums)

    @property
    def at_full_size(self) -> list[int]:
        """The images that are not reduced beside others: alpha that is rounded shows less of what is there."""
        reductions = self.dataset.reductions
        return [image for image in range(len(self)) if reductions is None or int(reductions[image]) == 1]

    def photograph(self, image: int) -> Photograph:
        """Return camera and sums of image `image`."""
        cameras = self.dataset.cameras
        fx, fy, cx, cy = (float(values[image]) for values in (cameras.fx, cameras.fy, cameras.cx, cameras.cy))
        return Photograph(cameras.camera_to_worlds[image].contiguous(), fx, fy, cx, cy, self.sums[image])


@torch.no_grad()
def visual_hull(silhouettes: Silhouettes, box: Tensor, resolution: int) -> Tensor:
    """Return the cells of a box that no image of a still scene shows to be empty, by refinement from coarse to fine.

    Args:
        silhouettes: silhouettes of the training images.
        box: (2, 3) minimum and maximum corner.
        resolution: number n of cells along each axis.

    Returns:
        (n^3,) bool; the index of a cell is (x n + y) n + z.
    """
    return _held(silhouettes, silhouettes.at_full_size, box, resolution, every=True)


@torch.no_grad()
def moving_hulls(silhouettes: Silhouettes, box: Tensor, resolution: int, times: Tensor, slices: int = 1) -> Tensor:
    """Return the cells of a box that may be occupied in each slice of time, of a scene that moves.

    A transparent pixel says that its ray is empty at the moment of its image, and nothing of other moments. So a cell
    is dropped from a slice if, of the images of that time and the nearest before and after, one shows it and its
    neighbours to be empty, and none shows matter in their direction. The margin of one cell allows for motion between
    the times of the images.

    Args:
        silhouettes: silhouettes of the M training images.
        box: (2, 3) minimum and maximum corner.
        resolution: number n of cells along each axis.
        times: (M,) times of the images, in [0, 1].
        slices: number T of equal parts of the time from 0 to 1.

    Returns:
        (T n^3,) bool; the index of cell (x, y, z) of slice s is ((s n + x) n + y) n + z.
    """
    images = silhouettes.at_full_size
    moments = times.cpu()[images]
    hulls = []
    for each in range(slices):
        within = _around(moments, each / slices, (each + 1) / slices)
        chosen = [images[i] for i in within]
        held = _held(silhouettes, chosen, box, resolution, every=False)
        held |= _held(silhouettes, chosen, box, resolution, every=True)
        grid = held.view(1, 1, resolution, resolution, resolution).float()
        hulls.append(functional.max_pool3d(grid, 3, stride=1, padding=1).view(-1) > 0)
    return torch.cat(hulls)


def _around(times: Tensor, start: float, end: float) -> list[int]:
    """Return which of `times` (M,) are from `start` to `end`, or equal to the nearest one before or after."""
    before, after = times[times < start], times[times > end]
    first = start if len(before) == 0 else float(before.max())
    last = end if len(after) == 0 else float(after.min())
    return ((times >= first) & (times <= last)).nonzero().squeeze(-1).tolist()


def _held(silhouettes: Silhouettes, images: Sequence[int], box: Tensor, resolution: int, every: bool) -> Tensor:
    """Return the cells (n^3,) bool that none of `images` shows to be empty, or where one shows matter (not `every`).

    `silhouettes`, `box` and `resolution` are as in `visual_hull`.
    """
    size = min(COARSEST, 1 << (resolution - 1).bit_length())
    count = -(-resolution // size)
    cubes = torch.cartesian_prod(*[torch.arange(count, device=box.device)] * 3) * size
    while True:
        low = box[0] + (box[1] - box[0]) * cubes / resolution
        edge = (box[1] - box[0]) * size / resolution
        centers, radius = (low + edge / 2).contiguous(), float(edge.norm()) / 2
        held = torch.full((len(cubes),), every, device=box.device)
        for image in images:
            hold_balls(silhouettes.photograph(image), centers, radius, held, every=every)
        cubes = cubes[held]
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
def pixels_near(silhouettes: Silhouettes, hull: Tensor, box: Tensor, resolution: int) -> PixelSet:
    """Return the pixels that may see a cell of the hull, counted through all images; all others see only background.

    Args:
        silhouettes: silhouettes of the images.
        hull: (n^3,) bool, as `visual_hull` returns it.
        box: (2, 3) minimum and maximum corner.
        resolution: number n of cells along each axis.
    """
    cells = hull.nonzero().squeeze(-1)
    corner = torch.stack([cells // resolution**2, cells // resolution % resolution, cells % resolution], dim=-1)
    centers = box[0] + (corner + 0.5) * (box[1] - box[0]) / resolution
    radius = float(((box[1] - box[0]) / resolution).norm()) / 2
    chosen = []
    for image in range(len(silhouettes)):
        near = pixels_near_balls(silhouettes.photograph(image), centers, radius)
        chosen.append(PixelSet.of_mask(near, int(silhouettes.dataset.cameras.offsets[image])))
    return PixelSet.joined(chosen)
