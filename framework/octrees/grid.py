"""The grid of cells that an octree's leaves are chosen from."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from nerfloom.kernels.octree.layout import BRICK


@dataclass(frozen=True)
class Grid:
    """A grid of cubic cells, of whole bricks along each axis."""

    origin: Tensor
    """(3,) corner of the first cell, scene units; float64 where the device has it."""
    cell: float
    """Edge of a cell, scene units."""
    size: tuple[int, int, int]
    """Bricks along each axis."""
    level: int = 0
    """Number of smaller grids inside of this one (`around`)."""

    @classmethod
    def of(cls, low: Tensor, high: Tensor, resolution: int) -> Grid:
        """Construct the grid of a box.

        Args:
            low, high: (3,) corners, scene units; float64 where the device has it.
            resolution: cells along the longest edge.
        """
        cell = float((high - low).max()) / resolution
        x, y, z = (max(math.ceil(float(edge) / (cell * BRICK) - 1e-6), 1) for edge in high - low)
        return cls(low, cell, (x, y, z))

    def around(self) -> Grid:
        """Return a grid with the same centre, twice the edges and as many cells, for the space outside of this one."""
        half = BRICK / 2 * self.cell * torch.tensor(self.size, dtype=torch.float64)
        return Grid(self.origin - half, 2 * self.cell, self.size, self.level + 1)

    def own(self, cells: Tensor) -> Tensor:
        """Return whether no smaller grid covers `cells` (N, 3), (N,) bool."""
        first = BRICK // 4 * torch.tensor(self.size)
        return ~((cells >= first) & (cells < 3 * first)).all(-1) | (self.level == 0)

    def surface(self) -> Tensor:
        """Return the cells (N, 3) int64 at the faces of the grid."""
        ends = [BRICK * count for count in self.size]
        found = [
            torch.cartesian_prod(
                *[torch.tensor([0, ends[a] - 1]) if a == b else torch.arange(ends[a]) for a in range(3)]
            )
            for b in range(3)
        ]
        return torch.cat(found)

    def positions(self, cells: Tensor) -> Tensor:
        """Return the positions (N, 3) float32 of coordinates `cells` (N, 3), whole or fractional."""
        return (self.origin + self.cell * cells.double()).float()
