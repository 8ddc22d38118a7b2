"""Visual hulls (Laurentini 1994): space that transparent pixels show to be empty before training.

A point that is fully transparent in some image is empty. So a cell can be skipped permanently if its projection into
one image has no opaque pixel. A pixel can be skipped if its rays meet only such cells.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from nerfloom.data.dataset import Dataset
from nerfloom.data.pixels.pixel_set import PixelSet
from nerfloom.geometry.bounds import cell_corners
from nerfloom.kernels.images.silhouettes import Photograph, hold_balls, opaque_sums, pixels_near_balls

MAX_CUBE = 8
"""Maximum side of the cubes tested first, cells."""
MIN_WITNESSES = 3
"""Number of images (or all, if fewer) that must show matter in the direction of a cell for it to be occupied in a
moving scene. Without this, many cells remain that no image has in its frame at that moment."""
KEPT_COUNTS = 48
"""Number of images with cached sums if the images exceed the memory."""


class _Counts(Sequence[Tensor]):
    """Cumulative sums of a data set's images; only those requested last stay in memory."""

    def __init__(self, dataset: Dataset) -> None:
        self._dataset = dataset
        self._kept: dict[int, Tensor] = {}

    def __len__(self) -> int:
        return len(self._dataset)

    def __getitem__(self, image: Any) -> Any:
        if not 0 <= image < len(self):
            raise IndexError(image)
        if image not in self._kept:
            opaque, kept = self._dataset.image(image)[..., 3] > 0, self._dataset.kept_of(image)
            if kept is not None:
                opaque |= ~kept  # masked pixels say nothing
            if len(self._kept) == KEPT_COUNTS:
                del self._kept[next(iter(self._kept))]
            self._kept[image] = opaque_sums(opaque)
        return self._kept[image]


@dataclass(frozen=True)
class Silhouettes:
    """The pixels of M images that are not fully transparent. Boxes to compare with them must be on the CPU."""

    dataset: Dataset
    """Images with alpha, and pinhole cameras."""
    sums: Sequence[Tensor]
    """M tensors (H + 1, W + 1) int32: number of such pixels above and to the left of a pixel's corner."""
    closed: bool = False
    """Whether space outside the images' frames is known to be empty."""

    @classmethod
    def of(cls, dataset: Dataset) -> Silhouettes:
        """Sum up each image of `dataset` on the CPU, so that counting in any rectangle of pixels takes four look-ups.

        If the images exceed the memory, so do the sums; they are then computed on each request. A hull is found in
        thousands of small dependent parts, which takes a GPU far longer than the CPU.
        """
        dataset = dataset.to("cpu")
        counts = _Counts(dataset)
        return cls(dataset, tuple(counts) if dataset.resident else counts)

    def __len__(self) -> int:
        return len(self.sums)

    def closed_if_whole(self) -> Silhouettes:
        """Return silhouettes with empty space outside their frames, if no image cuts off matter at its border."""
        return replace(self, closed=not any(self._touch_border(image) for image in self.at_full_size))

    def _touch_border(self, image: int) -> bool:
        sums = self.sums[image]
        inner = sums[-2, -2] - sums[-2, 1] - sums[1, -2] + sums[1, 1]
        return bool(sums[-1, -1] > inner)

    @property
    def at_full_size(self) -> list[int]:
        """Indices of the images at full size; in smaller copies, alpha is rounded and shows less."""
        reductions = self.dataset.reductions
        return [image for image in range(len(self)) if reductions is None or int(reductions[image]) == 1]

    def photograph(self, image: int) -> Photograph:
        """Return camera and sums of image `image`."""
        cameras = self.dataset.cameras
        fx, fy, cx, cy = cameras.intrinsics[image]
        return Photograph(cameras.camera_to_worlds[image].contiguous(), fx, fy, cx, cy, self.sums[image], self.closed)


@torch.no_grad()
def visual_hull(silhouettes: Silhouettes, box: Tensor, resolution: int) -> Tensor:
    """Return the cells of a box that no image of a static scene shows to be empty, by refinement from coarse to fine.

    Args:
        silhouettes: silhouettes of the training images.
        box: (2, 3) minimum and maximum corner.
        resolution: number n of cells along each axis.

    Returns:
        (n^3,) bool; the index of a cell is (x n + y) n + z.
    """
    return held_cells(silhouettes, silhouettes.at_full_size, box, resolution)


def held_cells(
    silhouettes: Silhouettes,
    images: Sequence[int],
    box: Tensor,
    resolution: int,
    margins: Sequence[float] | None = None,
    known: Tensor | None = None,
) -> Tensor:
    """Return the cells (n^3,) bool that none of `images` shows to be empty.

    `silhouettes`, `box` and `resolution` are as in `visual_hull`.

    Args:
        margins: for each image, the distance around a cell that must be shown to be empty as well; also,
            `MIN_WITNESSES` of the images must show matter in the cell's direction. None for a static scene.
        known: (n^3,) bool, cells that need not be tested; None for none.
    """
    size = min(MAX_CUBE, 1 << (resolution - 1).bit_length())
    count = -(-resolution // size)
    cubes = torch.cartesian_prod(*[torch.arange(count, device=box.device)] * 3) * size
    while True:
        if known is not None and resolution % size == 0:
            cubes = cubes[~_whole_cubes(known, resolution, size)[tuple((cubes // size).unbind(1))]]
        low = box[0] + (box[1] - box[0]) * cubes / resolution
        edge = (box[1] - box[0]) * size / resolution
        centers, radius = (low + edge / 2).contiguous(), float(edge.norm()) / 2
        cubes = cubes[held_balls(silhouettes, images, centers, radius, margins)]
        if size == 1:
            break
        size //= 2
        corners = torch.cartesian_prod(*[torch.tensor([0, size], device=box.device)] * 3)
        cubes = (cubes[:, None] + corners).reshape(-1, 3)
        cubes = cubes[(cubes < resolution).all(-1)]
    hull = torch.zeros(resolution**3, dtype=torch.bool, device=box.device)
    hull[(cubes[:, 0] * resolution + cubes[:, 1]) * resolution + cubes[:, 2]] = True
    return hull


def held_balls(
    silhouettes: Silhouettes, images: Sequence[int], centers: Tensor, radius: float, margins: Sequence[float] | None
) -> Tensor:
    """Return the balls (N,) bool that none of `images` shows to be empty.

    `silhouettes`, `images` and `margins` are as in `held_cells`.

    Args:
        centers: (N, 3) centres of the balls, contiguous.
        radius: radius of the balls, scene units.
    """
    held = torch.ones(len(centers), dtype=torch.bool, device=centers.device)
    reach = [radius + margin for margin in margins or [0.0] * len(images)]
    for image, r in zip(images, reach, strict=True):
        hold_balls(silhouettes.photograph(image), centers, r, held, every=True)
    if margins is not None:  # only for the few remaining balls
        held[held.clone()] = _witnessed(silhouettes, images, centers[held], reach)
    return held


def _whole_cubes(cells: Tensor, resolution: int, size: int) -> Tensor:
    """Return the cubes, `size` cells wide and counted along each axis, where all of `cells` (n^3,) bool are True."""
    count = resolution // size
    return cells.view(count, size, count, size, count, size).all(5).all(3).all(1)


def _witnessed(silhouettes: Silhouettes, images: Sequence[int], centers: Tensor, reach: Sequence[float]) -> Tensor:
    """Return whether `MIN_WITNESSES` of `images` (all, if fewer) show matter in the direction of each ball, (N,)."""
    wanted = min(MIN_WITNESSES, len(images))
    count = torch.zeros(len(centers), dtype=torch.int32, device=centers.device)
    for image, radius in zip(images, reach, strict=True):
        enough = count >= wanted
        if bool(enough.all()):
            break
        shown = enough.clone()  # balls with enough witnesses are not tested again
        hold_balls(silhouettes.photograph(image), centers, radius, shown, every=False)
        count += shown & ~enough
    return count >= wanted


@torch.no_grad()
def pixels_near(silhouettes: Silhouettes, hull: Tensor, box: Tensor, resolution: int) -> PixelSet:
    """Return the pixels, counted over all images, that may see the `hull` (n^3,); others see only background.

    `silhouettes` belong to the images. `box` (2, 3) has `resolution` n cells along each axis.
    """
    cells = hull.nonzero().squeeze(-1)
    centers = box[0] + (cell_corners(cells, resolution) + 0.5) * (box[1] - box[0]) / resolution
    radius = float(((box[1] - box[0]) / resolution).norm()) / 2
    chosen = []
    for image in range(len(silhouettes)):
        near = pixels_near_balls(silhouettes.photograph(image), centers, radius)
        chosen.append(PixelSet.of_mask(near, int(silhouettes.dataset.cameras.offsets[image])))
    return PixelSet.joined(chosen)
