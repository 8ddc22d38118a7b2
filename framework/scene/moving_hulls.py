"""Visual hulls of a moving scene: space that transparent pixels show to be empty at a time.

The ray of a transparent pixel is empty at the time of its image. A ball is empty at another moment if the image shows a
larger ball to be empty. The radius grows by the distance that matter moves in between (`nerfloom.scene.speed`). So a
cell may be occupied at a moment if no image shows the ball around it to be empty, and if `WITNESSES` of the images near
that moment show matter in its direction.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise

import torch
from torch import Tensor

from nerfloom.data.motion_bound import MotionBound
from nerfloom.scene.silhouettes import Silhouettes, held_cells

IMAGES_PER_MOMENT = 32
"""Number of images used for a moment: the ones with the least motion between their time and the moment."""
MOTION_PER_MOMENT = 1 / 64
"""Distance that matter may move within a moment, in longest edges of the box, unless moments get too many."""
MAX_MOMENTS = 96
"""Maximum number of moments in all, beyond one for each slice."""
BOX_CELLS = 32
"""Cells along each axis in the search for the smallest box of a moving scene."""


@torch.no_grad()
def moving_hulls(
    silhouettes: Silhouettes, box: Tensor, resolution: int, times: Tensor, bound: MotionBound, slices: int = 1
) -> Tensor:
    """Return the cells of a box that may be occupied in each time slice of a moving scene.

    A slice is the union of its moments.

    Args:
        silhouettes: silhouettes of the M training images.
        box: (2, 3) minimum and maximum corner.
        resolution: number n of cells along each axis.
        times: (M,) times of the images, in [0, 1].
        bound: distance that matter may have moved up to each time.
        slices: number T of equal parts of the time from 0 to 1.

    Returns:
        (T n^3,) bool; the index of cell (x, y, z) of slice s is ((s n + x) n + y) n + z.
    """
    hulls = torch.zeros(slices, resolution**3, dtype=torch.bool, device=box.device)
    for number, images, margins in _moments(silhouettes, box, times, bound, slices):
        hulls[number] |= held_cells(silhouettes, images, box, resolution, margins, known=hulls[number])
    return hulls.view(-1)


@torch.no_grad()
def moving_box(silhouettes: Silhouettes, box: Tensor, times: Tensor, bound: MotionBound) -> Tensor:
    """Return the smallest box (2, 3) within `box` of everything that may be occupied at any time in a moving scene.

    If no image has matter at its border, space outside the images' frames also counts as empty. `silhouettes`, `box`,
    `times` and `bound` are as in `moving_hulls`.
    """
    silhouettes = silhouettes.closed_if_whole()
    for _ in range(3):  # with smaller cells in each round
        inside = torch.zeros((BOX_CELLS,) * 3, dtype=torch.bool, device=box.device)
        ends = None
        for _, images, margins in _moments(silhouettes, box, times, bound, 1):
            inside |= held_cells(silhouettes, images, box, BOX_CELLS, margins, known=inside.view(-1)).view_as(inside)
            if len(cells := inside.nonzero()):
                ends = torch.stack([cells.amin(0), cells.amax(0) + 1])
                (x0, y0, z0), (x1, y1, z1) = ends.tolist()
                inside[x0:x1, y0:y1, z0:z1] = True  # the middle does not change the box
        if ends is None:
            return box
        box = box[0] + (box[1] - box[0]) * ends / BOX_CELLS
    return box


def nearest(margins: Tensor) -> list[int]:
    """Return the sorted indices of the `IMAGES_PER_MOMENT` smallest of `margins` (M,), with all ties of the last."""
    largest = margins.kthvalue(min(IMAGES_PER_MOMENT, len(margins))).values
    chosen = (margins <= largest).nonzero().squeeze(-1)
    return chosen[margins[chosen].argsort(stable=True)].tolist()


def _moments(
    silhouettes: Silhouettes, box: Tensor, times: Tensor, bound: MotionBound, slices: int
) -> Iterator[tuple[int, list[int], list[float]]]:
    """Yield for each moment its slice, the images near it, and for each image the distance matter moves in between.

    `silhouettes`, `box`, `times`, `bound` and `slices` are as in `moving_hulls`.
    """
    images = silhouettes.at_full_size
    taken = bound.at(times.cpu()[images])
    ends = bound.at(torch.linspace(0, 1, slices + 1))
    span = max(MOTION_PER_MOMENT * float((box[1] - box[0]).max()), float(ends[-1] - ends[0]) / MAX_MOMENTS)
    for number, (first, last) in enumerate(pairwise(ends.tolist())):
        parts = max(math.ceil((last - first) / span), 1)
        for start, end in pairwise(torch.linspace(first, last, parts + 1, dtype=taken.dtype)):
            margins = torch.maximum((taken - start).abs(), (taken - end).abs())
            near = nearest(margins)
            yield number, [images[i] for i in near], margins[near].tolist()
