"""Visual hulls (Laurentini 1994): space that transparent images show to be empty before training.

A point that is fully transparent in some image is empty. Therefore a cell of space whose projection into one image has
no opaque pixel can be skipped for good, and so can the pixels whose ray meets no other cell.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from framework.data.dataset import Dataset
from framework.data.pixel_set import PixelSet
from framework.geometry.bounds import cell_corners
from framework.kernels.silhouettes import Photograph, hold_balls, opaque_sums, pixels_near_balls

COARSEST = 8
"""Maximum side of the first cubes tested, cells."""
FASTEST = 0.5
"""Speed that matter is assumed not to exceed, in longest edges of the box for the time from 0 to 1."""
REACH = 0.05
"""Distance, longest edges of the box, that matter may move between a moment and the images that are taken for it."""
WITNESSES = 3
"""Images about a moment, if there are as many, that must show matter in the direction of what may be occupied. Without
them much is left that no image has in its frame at that moment."""
MOST_MOMENTS = 32
"""Maximum number of moments whose hulls make up those of slices."""
FRAME = 400
"""Maximum side of the images by which the smallest box of a moving scene is found, pixels."""
BOX_CELLS = 32
"""Cells along each axis by which the smallest box of a moving scene is found."""


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
    """The pixels of M images that are not fully transparent; the boxes that they are compared with are on the CPU."""

    dataset: Dataset
    """Images with alpha, and pinhole cameras."""
    sums: Sequence[Tensor]
    """M tensors (H + 1, W + 1) int32: number of such pixels above and to the left of a pixel's corner."""

    @classmethod
    def of(cls, dataset: Dataset) -> Silhouettes:
        """Sum up each image of `dataset`, on the CPU, so that the count in any rectangle of pixels takes four look-ups.

        If the images exceed the memory, so do the sums; they are then computed each time they are requested. A hull is
        found in thousands of small parts, each by the answers to those before, which takes a GPU far longer.
        """
        dataset = dataset.to("cpu")
        counts = _Counts(dataset)
        return cls(dataset, tuple(counts) if dataset.resident else counts)

    def __len__(self) -> int:
        return len(self.sums)

    def touch_border(self, image: int) -> bool:
        """Return whether image `image` has a pixel at its border that is not fully transparent."""
        sums = self.sums[image]
        inner = sums[-2, -2] - sums[-2, 1] - sums[1, -2] + sums[1, 1]
        return bool(sums[-1, -1] > inner)

    def widened(self) -> Silhouettes:
        """Return silhouettes in frames of twice the size, empty around the images, in at most `FRAME` pixels.

        This is what the images show if none cuts through what it shows: nothing is outside their frames, either.
        """
        cameras, sums = self.dataset.cameras, []
        factor = max(-(-int(torch.maximum(cameras.widths, cameras.heights).max()) // (FRAME // 2)), 1)
        height, width = (int(size.max()) // (2 * factor) for size in (cameras.heights, cameras.widths))
        for own in self.sums:
            rows, columns = (
                (torch.arange(-edge, -(-size // factor) + edge + 1, device=own.device) * factor).clamp(0, size)
                for size, edge in ((own.shape[0] - 1, height), (own.shape[1] - 1, width))
            )
            sums.append(own[rows][:, columns].contiguous())
        cameras = replace(
            cameras,
            fx=cameras.fx / factor,
            fy=cameras.fy / factor,
            cx=cameras.cx / factor + width,
            cy=cameras.cy / factor + height,
        )
        return Silhouettes(replace(self.dataset, cameras=cameras), tuple(sums))

    @property
    def at_full_size(self) -> list[int]:
        """The images that are not reduced beside others: alpha that is rounded shows less of what is there."""
        reductions = self.dataset.reductions
        return [image for image in range(len(self)) if reductions is None or int(reductions[image]) == 1]

    def photograph(self, image: int) -> Photograph:
        """Return camera and sums of image `image`."""
        cameras = self.dataset.cameras
        fx, fy, cx, cy = cameras.intrinsics[image]
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
    return _held(silhouettes, silhouettes.at_full_size, box, resolution)


@torch.no_grad()
def moving_hulls(silhouettes: Silhouettes, box: Tensor, resolution: int, times: Tensor, slices: int = 1) -> Tensor:
    """Return the cells of a box that may be occupied in each slice of time, of a scene that moves.

    A transparent pixel says that its ray is empty at the time of its image. At another moment, a ball is empty if the
    image shows the larger one to be empty that matter could have come from: its radius is greater by what matter moves
    meanwhile, at most `FASTEST`. So a cell may be occupied at a moment if no image shows the ball around it to be empty
    and some `WITNESSES` of the images about that time show matter in its direction. A slice has the cells of all its
    moments.

    Args:
        silhouettes: silhouettes of the M training images.
        box: (2, 3) minimum and maximum corner.
        resolution: number n of cells along each axis.
        times: (M,) times of the images, in [0, 1].
        slices: number T of equal parts of the time from 0 to 1.

    Returns:
        (T n^3,) bool; the index of cell (x, y, z) of slice s is ((s n + x) n + y) n + z.
    """
    hulls = torch.zeros(slices, resolution**3, dtype=torch.bool, device=box.device)
    for number, images, margins in _moments(silhouettes, box, times, slices):
        hulls[number] |= _held(silhouettes, images, box, resolution, margins, known=hulls[number])
    return hulls.view(-1)


@torch.no_grad()
def moving_box(silhouettes: Silhouettes, box: Tensor, times: Tensor) -> Tensor:
    """Return the smallest box (2, 3), inside `box`, of all that may be occupied at any time, of a scene that moves.

    If no image has matter at its border, what is outside an image's frame is taken to be empty, too.

    Args:
        silhouettes: silhouettes of the M training images.
        box: (2, 3) minimum and maximum corner.
        times: (M,) times of the images, in [0, 1].
    """
    if not any(silhouettes.touch_border(image) for image in silhouettes.at_full_size):
        silhouettes = silhouettes.widened()
    for _ in range(3):  # each time with smaller cells
        inside = torch.zeros((BOX_CELLS,) * 3, dtype=torch.bool, device=box.device)
        ends = None
        for _, images, margins in _moments(silhouettes, box, times, 1):
            inside |= _held(silhouettes, images, box, BOX_CELLS, margins, known=inside.view(-1)).view_as(inside)
            if len(cells := inside.nonzero()):
                ends = torch.stack([cells.amin(0), cells.amax(0) + 1])
                (x0, y0, z0), (x1, y1, z1) = ends.tolist()
                inside[x0:x1, y0:y1, z0:z1] = True  # what is in the middle does not change the box
        if ends is None:
            return box
        box = box[0] + (box[1] - box[0]) * ends / BOX_CELLS
    return box


def _moments(
    silhouettes: Silhouettes, box: Tensor, times: Tensor, slices: int
) -> Iterator[tuple[int, list[int], list[float]]]:
    """Yield the slice of each moment, the images about it, and for each how far matter may move meanwhile.

    `silhouettes`, `box`, `times` and `slices` are as in `moving_hulls`.
    """
    images = silhouettes.at_full_size
    taken = times.cpu()[images]
    parts = max(round(min(len(taken.unique()), MOST_MOMENTS) / slices), 1)
    speed, half = FASTEST * float((box[1] - box[0]).max()), 0.5 / (slices * parts)
    for part in range(slices * parts):
        apart = (taken - (2 * part + 1) * half).abs()
        near = (apart <= max(REACH / FASTEST, float(apart.min()))).nonzero().squeeze(-1).tolist()
        yield part // parts, [images[i] for i in near], [speed * (float(apart[i]) + half) for i in near]


def _held(
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
        margins: distance, for each image, up to which around a cell all must be shown to be empty; `WITNESSES` must
            then show matter in the cell's direction, too. None for a still scene, without either.
        known: (n^3,) bool, cells that need not be found; None for none.
    """
    size = min(COARSEST, 1 << (resolution - 1).bit_length())
    count = -(-resolution // size)
    cubes = torch.cartesian_prod(*[torch.arange(count, device=box.device)] * 3) * size
    while True:
        if known is not None and resolution % size == 0:
            cubes = cubes[~_whole_cubes(known, resolution, size)[tuple((cubes // size).unbind(1))]]
        low = box[0] + (box[1] - box[0]) * cubes / resolution
        edge = (box[1] - box[0]) * size / resolution
        centers, radius = (low + edge / 2).contiguous(), float(edge.norm()) / 2
        held = torch.ones(len(cubes), dtype=torch.bool, device=box.device)
        reach = [radius + margin for margin in margins or [0.0] * len(images)]
        for image, r in zip(images, reach, strict=True):
            hold_balls(silhouettes.photograph(image), centers, r, held, every=True)
        if margins is not None:  # only of what is left, which is little
            held[held.clone()] = _witnessed(silhouettes, images, centers[held], reach)
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


def _whole_cubes(cells: Tensor, resolution: int, size: int) -> Tensor:
    """Return of which cubes, `size` cells wide and counted along each axis, all of `cells` (n^3,) bool are true."""
    count = resolution // size
    return cells.view(count, size, count, size, count, size).all(5).all(3).all(1)


def _witnessed(silhouettes: Silhouettes, images: Sequence[int], centers: Tensor, reach: Sequence[float]) -> Tensor:
    """Return in the direction of which balls (N,) `WITNESSES` of `images` show matter, or all if they are fewer."""
    wanted = min(WITNESSES, len(images))
    count = torch.zeros(len(centers), dtype=torch.int32, device=centers.device)
    for image, radius in zip(images, reach, strict=True):
        enough = count >= wanted
        if bool(enough.all()):
            break
        shown = enough.clone()  # these are not looked at again
        hold_balls(silhouettes.photograph(image), centers, radius, shown, every=False)
        count += shown & ~enough
    return count >= wanted


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
    centers = box[0] + (cell_corners(cells, resolution) + 0.5) * (box[1] - box[0]) / resolution
    radius = float(((box[1] - box[0]) / resolution).norm()) / 2
    chosen = []
    for image in range(len(silhouettes)):
        near = pixels_near_balls(silhouettes.photograph(image), centers, radius)
        chosen.append(PixelSet.of_mask(near, int(silhouettes.dataset.cameras.offsets[image])))
    return PixelSet.joined(chosen)
