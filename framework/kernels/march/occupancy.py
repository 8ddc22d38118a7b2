"""The occupancy grid of a march: its cells, the forms used for look-ups, and the update of occupied cells.

A grid has one box, or several nested boxes, each twice as large with the same number of cells (Instant-NGP, Mueller et
al. 2022, appendix E.2). A position belongs to the smallest box that contains it, so the cells in the middle of a larger
box are never looked up. A grid of one box may have time slices, each with its own cells.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import torch
from torch import Tensor

from nerfloom.geometry.bounds import nested_boxes
from nerfloom.kernels import native
from nerfloom.kernels.dispatch import CPP, Operation
from nerfloom.kernels.triton_backend import later

BLOCK = 4
"""Cells along an edge of a block; a block is a cell of the coarser level."""
ROUNDING = 1e-5
"""Relative tolerance of the mean opacity, so that rounding errors do not empty a grid of equal cells."""


@dataclass(frozen=True)
class Occupancy:
    """The occupied cells of a grid over a box, over L nested boxes, or over a box in T slices of time."""

    occupied: Tensor
    """(L n^3,) or (T n^3,) bool; the index of cell (x, y, z) of box or slice l is ((l n + x) n + y) n + z."""
    box: Tensor
    """(2, 3) minimum and maximum corner of the smallest box, scene units."""
    resolution: int
    """Number n of cells along each axis of a box; a multiple of 4 if there are several."""
    levels: int = 1
    """Number L of boxes."""
    slices: int = 1
    """Number T of equal parts of the time from 0 to 1; 1 if there are several boxes."""

    @cached_property
    def outer(self) -> Tensor:
        """(2, 3) corners of the largest box."""
        return nested_boxes(self.box, self.levels)[-1]

    @cached_property
    def filled(self) -> Tensor:
        """(L, n, n, n) or (T, n, n, n) `occupied`, with the middle of each larger box filled in from the smaller one.

        A cell there is occupied if one of its eight smaller cells is, so that a box can be traversed by its own cells.
        """
        n = self.resolution
        boxes = self.occupied.view(self.levels * self.slices, n, n, n)
        if self.levels == 1:
            return boxes
        boxes, middle = boxes.clone(), slice(n // 4, n - n // 4)
        for smaller, larger in pairwise(boxes):
            any_x = smaller[0::2] | smaller[1::2]
            any_y = any_x[:, 0::2] | any_x[:, 1::2]
            larger[middle, middle, middle] = any_y[..., 0::2] | any_y[..., 1::2]
        return boxes

    @cached_property
    def packed(self) -> tuple[Tensor, Tensor]:
        """(L or T, ceil(n^3 / 8)) uint8 with one bit per cell, (L or T, ceil(n / 4)^3) uint8, for the compiled march.

        The second tensor has, for each block of 4^3 cells, the distance in blocks to the nearest block of its box with
        an occupied cell.
        """
        n, count = self.resolution, self.levels * self.slices
        bits = torch.empty(count, (n**3 + 7) // 8, dtype=torch.uint8)
        blocks = torch.empty(count, math.ceil(n / BLOCK) ** 3, dtype=torch.uint8)
        for cells, its_bits, its_blocks in zip(self.filled, bits, blocks, strict=True):
            address = native.pointer(cells, "the occupancy", (n, n, n), torch.bool)
            _pack(address, n, its_bits.data_ptr(), its_blocks.data_ptr())
        return bits, blocks

    @cached_property
    def distances(self) -> Tensor:
        """(L or T times ceil(n / 4)^3,) uint8 distances of blocks, as in `packed`, up to 16, for the march on a GPU."""
        return self._distances()

    def _distances(self) -> Tensor:
        find = later("march.waves_triton", "block_distances")
        return torch.cat([find(cells.flatten(), self.resolution) for cells in self.filled])

    def refresh(self) -> None:
        """Recompute everything derived from `occupied`, which has changed.

        On a device that runs ahead of Python, tensors keep their memory, because captured steps refer to it.
        """
        for name in ("filled", "packed"):
            vars(self).pop(name, None)
        if "distances" in vars(self):
            self.distances.copy_(self._distances())
        for radius, cells in self._near.items():
            cells.copy_(dilated(self, radius))

    def slices_of(self, times: Tensor | None) -> Tensor | None:
        """Return the slice (R,) int64 of each of `times` (R,); None if there is only one.

        Raises:
            ValueError: if there are several slices and `times` is None.
        """
        if self.slices == 1:
            return None
        if times is None:
            raise ValueError("this grid has slices of time: it needs the times of rays")
        return (times * self.slices).long().clamp(0, self.slices - 1)

    @cached_property
    def edge(self) -> float:
        """Length of the shortest edge of a cell of the smallest box, scene units."""
        return ((self.box[1] - self.box[0]) / self.resolution).min().item()

    def near(self, radius: int) -> Tensor:
        """Return the cells (T n^3,) bool with an occupied cell within `radius` cells along every axis."""
        if radius not in self._near:
            self._near[radius] = dilated(self, radius)
        return self._near[radius]

    @cached_property
    def _near(self) -> dict[int, Tensor]:
        return {}

    def cells(self, positions: Tensor, slices: Tensor | None = None) -> Tensor:
        """Return the index (N,) of the cell of each position; the nearest cell if it is outside.

        Args:
            positions: (N, 3) scene coordinates.
            slices: (N,) slice of time of each; None for the first.
        """
        scale = self.resolution / (self.box[1] - self.box[0])
        places = (positions - self.box[0]) * scale
        if self.levels > 1:
            return self._nested_cells(places)
        x, y, z = places.long().clamp(0, self.resolution - 1).unbind(-1)
        x = x if slices is None else slices * self.resolution + x
        return (x * self.resolution + y) * self.resolution + z

    def _nested_cells(self, places: Tensor) -> Tensor:
        """Return the index (N,) of the cell at each of `places` (N, 3), given in cells of the smallest box."""
        n = self.resolution
        across = places - n / 2
        level = torch.frexp(across.abs().amax(-1) / (n / 2)).exponent.long().clamp(0, self.levels - 1)
        size = torch.tensor([0.5**box for box in range(self.levels)], dtype=places.dtype, device=places.device)
        x, y, z = (across * size[level][:, None] + n / 2).long().clamp(0, n - 1).unbind(-1)
        return ((level * n + x) * n + y) * n + z


def refresh_occupancy_reference(
    density: Tensor, occupied: Tensor, decay: float, step: float, threshold: float, elsewhere: float = 0.0
) -> None:
    """Compute `refresh_occupancy` of `density`, `occupied`, `decay`, `step`, `threshold` and `elsewhere` in PyTorch."""
    density *= decay
    alpha = -torch.expm1(-density * step)
    mean = (alpha.nanmean() * (1 - ROUNDING)).nan_to_num(nan=threshold)  # NaN if all values are
    least = mean.clamp(min=elsewhere).clamp(max=threshold)
    occupied.copy_(~(alpha < least))


@torch.no_grad()
def refresh_occupancy(
    density: Tensor, occupied: Tensor, decay: float, step: float, threshold: float, elsewhere: float = 0.0
) -> None:
    """Mark, in place, the cells with an opacity over one step of at least a threshold.

    Args:
        density: (n^3,) density of each cell, 1/length, multiplied by `decay` in place; infinite if unknown. NaN cells
            are marked, so that a broken field is noticed, and left out of the mean.
        occupied: (n^3,) bool, written.
        decay: factor of the densities.
        step: length of a step, scene units.
        threshold: minimum opacity, or the mean opacity over all cells if that is less.
        elsewhere: an opacity that replaces the mean if it is larger, so that an empty box is emptied.
    """
    REFRESH_OCCUPANCY((density,), density, occupied, decay, step, threshold, elsewhere)


REFRESH_OCCUPANCY = Operation("refresh_occupancy", refresh_occupancy_reference)


@REFRESH_OCCUPANCY.implementation(CPP)
def _refresh_compiled(
    density: Tensor, occupied: Tensor, decay: float, step: float, threshold: float, elsewhere: float = 0.0
) -> None:
    cells = len(density)
    _refresh(
        native.pointer(density, "density", (cells,)), cells, decay, step, threshold, elsewhere,
        native.pointer(occupied, "the occupancy", (cells,), torch.bool), native.threads(),
    )  # fmt: skip


def own_cells(levels: int, resolution: int) -> Tensor:
    """Return the cells (L n^3,) bool of L nested boxes of n^3 cells that no smaller box covers.

    Args:
        levels: number L of boxes.
        resolution: number n of cells along each axis of a box; a multiple of 4 if there are several.
    """
    own = torch.ones(levels, resolution, resolution, resolution, dtype=torch.bool)
    middle = slice(resolution // 4, resolution - resolution // 4)
    own[1:, middle, middle, middle] = False
    return own.view(-1)


def dilated(occupancy: Occupancy, radius: int) -> Tensor:
    """Return the cells (T n^3,) bool of `occupancy`, of one box, with an occupied cell within `radius` on all axes."""
    n = occupancy.resolution
    grid = occupancy.occupied.view(-1, n, n, n)
    for axis in range(1, 4):
        out = grid.clone()
        for shift in range(1, min(radius, n - 1) + 1):
            out.narrow(axis, 0, n - shift).logical_or_(grid.narrow(axis, shift, n - shift))
            out.narrow(axis, shift, n - shift).logical_or_(grid.narrow(axis, 0, n - shift))
        grid = out
    return grid.reshape(-1)


_pack: Callable[..., None] = native.Function("pack_occupancy", "pipp")
_refresh: Callable[..., None] = native.Function("refresh_occupancy", "pqffffpi")
