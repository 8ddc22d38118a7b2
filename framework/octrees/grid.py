"""The grid of cells that an octree's leaves are chosen from."""

from __future__ import annotations

import math
from dataclasses import dataclass

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

    def positions(self, cells: Tensor) -> Tensor:
        """Return the positions (N, 3) float32 of coordinates `cells` (N, 3), whole or fractional."""
        return (self.origin + self.cell * cells.double()).float()
