"""The occupancy grid of a march: its cells, in the forms in which they are looked up, and when they are occupied."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from framework.kernels import native
from framework.kernels.dispatch import CPP, Operation
from framework.kernels.triton_kernels import later

BLOCK = 4
"""Cells along an edge of a block, which is a cell of the coarser level."""
ROUNDING = 1e-5
"""Relative tolerance of the mean opacity, so that rounding errors do not empty a grid whose cells are all equal."""


@dataclass(frozen=True)
class Occupancy:
    """The occupied cells of a grid over a box."""

    occupied: Tensor
    """(T n^3,) bool; the index of cell (x, y, z) of slice s is ((s n + x) n + y) n + z."""
    box: Tensor
    """(2, 3) minimum and maximum corner, scene units."""
    resolution: int
    """Number n of cells along each axis."""
    slices: int = 1
    """Number T of equal parts of the time from 0 to 1, each of which has cells of its own."""

    @cached_property
    def packed(self) -> tuple[Tensor, Tensor]:
        """(T, ceil(n^3 / 8)) uint8 with one bit per cell, and (T, ceil(n / 4)^3) uint8, for the compiled march.

        The second tensor has, for each block of 4^3 cells, the distance in blocks to the nearest block with an occupied
        cell.
        """
        count, n = self.slices, self.resolution
        bits = torch.empty(count, (n**3 + 7) // 8, dtype=torch.uint8)
        blocks = torch.empty(count, math.ceil(n / BLOCK) ** 3, dtype=torch.uint8)
        address = native.pointer(self.occupied, "the occupancy", (count * n**3,), torch.bool)
        _pack(address, n, count, bits.data_ptr(), blocks.data_ptr(), native.threads())
        return bits, blocks

    @cached_property
    def distances(self) -> Tensor:
        """(T, ceil(n / 4)^3) uint8 distances of blocks, as in `packed`, but at most 16, for the march on a GPU."""
        return later("march", "block_distances")(self.occupied, self.resolution, self.slices)

    def slices_of(self, times: Tensor | None) -> Tensor | None:
        """Return the slice (R,) int64 of each of `times` (R,); None if there is only one.

        Raises:
            ValueError: if there are several, and `times` is None.
        """
        if self.slices == 1:
            return None
        if times is None:
            raise ValueError("this grid has slices of time: it needs the times of rays")
        return (times * self.slices).long().clamp(0, self.slices - 1)

    @cached_property
    def edge(self) -> float:
        """Length of the shortest edge of a cell, scene units."""
        return ((self.box[1] - self.box[0]) / self.resolution).min().item()

    def near(self, radius: int) -> Tensor:
        """Return the cells (T n^3,) bool that have an occupied cell within `radius` cells along every axis."""
        if radius not in self._near:
            self._near[radius] = dilated(self, radius)
        return self._near[radius]

    @cached_property
    def _near(self) -> dict[int, Tensor]:
        return {}

    def cells(self, positions: Tensor, slices: Tensor | None = None) -> Tensor:
        """Return the index (N,) of the cell of each position, or of the nearest cell if it is outside.

        Args:
            positions: (N, 3) scene coordinates.
            slices: (N,) slice of each; None for the first.
        """
        n = self.resolution
        x, y, z = ((positions - self.box[0]) * (n / (self.box[1] - self.box[0]))).long().clamp(0, n - 1).unbind(-1)
        return ((x if slices is None else slices * n + x) * n + y) * n + z


def refresh_occupancy_reference(density: Tensor, occupied: Tensor, decay: float, step: float, threshold: float) -> None:
    """Compute `refresh_occupancy` of `density`, `occupied`, `decay`, `step` and `threshold` in PyTorch."""
    density *= decay
    alpha = -torch.expm1(-density * step)
    least = (alpha.nanmean() * (1 - ROUNDING)).nan_to_num(nan=threshold).clamp(max=threshold)  # NaN if all are
    occupied.copy_(~(alpha < least))


@torch.no_grad()
def refresh_occupancy(density: Tensor, occupied: Tensor, decay: float, step: float, threshold: float) -> None:
    """Mark, in place, the cells whose opacity over one step is at least a threshold.

    Args:
        density: (N,) density of each cell, 1/length, which is multiplied by `decay` in place; infinite if unknown.
            Cells of NaN are marked, so that a broken field is noticed, and left out of the mean.
        occupied: (N,) bool, to be written.
        decay: factor of the densities.
        step: length of a step, scene units.
        threshold: minimum opacity, or the mean opacity over all cells if that is less.
    """
    REFRESH_OCCUPANCY((density,), density, occupied, decay, step, threshold)


REFRESH_OCCUPANCY = Operation("refresh_occupancy", refresh_occupancy_reference)


@REFRESH_OCCUPANCY.implementation(CPP)
def _refresh_compiled(density: Tensor, occupied: Tensor, decay: float, step: float, threshold: float) -> None:
    cells = len(density)
    _refresh(
        native.pointer(density, "density", (cells,)), cells, decay, step, threshold,
        native.pointer(occupied, "the occupancy", (cells,), torch.bool), native.threads(),
    )  # fmt: skip


def dilated(occupancy: Occupancy, radius: int) -> Tensor:
    """Return the cells (T n^3,) bool of `occupancy` with an occupied cell within `radius` cells along each axis."""
    n = occupancy.resolution
    grid = occupancy.occupied.view(-1, n, n, n)
    for axis in range(1, 4):
        out = grid.clone()
        for shift in range(1, min(radius, n - 1) + 1):
            out.narrow(axis, 0, n - shift).logical_or_(grid.narrow(axis, shift, n - shift))
            out.narrow(axis, shift, n - shift).logical_or_(grid.narrow(axis, 0, n - shift))
        grid = out
    return grid.reshape(-1)


_pack: Callable[..., None] = native.Function("pack_occupancy", "piippi")
_refresh: Callable[..., None] = native.Function("refresh_occupancy", "pqfffpi")
