"""The part of a box that silhouettes leave, and the first leaves of an octree there."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from nerfloom.geometry.bounds import box_around_cells
from nerfloom.kernels.octree.layout import BRICK, OctreeLayout
from nerfloom.octrees.grid import Grid


class Hull(nn.Module):
    """A grid over the box, where cells that images show to be empty are marked (`nerfloom.samplers.base.Carved`).

    Args:
        box: (2, 3) corners of the box, scene units.
        resolution: number of cells along each axis.
    """

    box: Tensor
    carved: Tensor
    levels = slices = 1

    def __init__(self, box: Tensor, resolution: int) -> None:
        super().__init__()
        self.resolution = resolution
        self.register_buffer("box", box.clone())
        self.register_buffer("carved", torch.zeros(resolution**3, dtype=torch.bool))

    @property
    def inside(self) -> Tensor:
        """Cells (n, n, n) bool that are not marked, indexed by x, y and z."""
        return (~self.carved).view(self.resolution, self.resolution, self.resolution)

    def carve(self, hull: Tensor) -> None:
        """Mark all cells outside `hull`, (n^3,) bool, as empty."""
        self.carved.copy_(~hull)

    def leaves(self, cells: int) -> OctreeLayout:
        """Return the leaves that overlap cells without a mark, in a grid over the smallest box around these.

        Args:
            cells: number of leaves along the longest edge of the grid.
        """
        inside, box = self.inside, self.box
        around = box_around_cells(inside, box)
        low, high = box if around is None else around
        grid = Grid.of(low, high, cells)
        edge = float(torch.tensor(grid.cell, dtype=torch.float32))  # rounded, as in a checkpoint
        return OctreeLayout.build(low, edge, grid.size, overlapped(inside, box, grid).nonzero())[0]


def overlapped(inside: Tensor, box: Tensor, grid: Grid) -> Tensor:
    """Return the cells (X, Y, Z) bool of a grid that overlap some cells of a box.

    Args:
        inside: (n, n, n) bool, True for these cells.
        box: (2, 3) corners of the box, scene units.
        grid: the other grid.
    """
    found = inside.long()
    for axis, bricks in enumerate(grid.size):
        edge = float(box[1, axis] - box[0, axis]) / len(inside)
        steps = torch.arange(BRICK * bricks, device=box.device)
        begins = float(grid.origin[axis] - box[0, axis]) / edge + grid.cell / edge * steps
        # Faces that two cells share, up to rounding, are no overlap.
        first = (begins + 1e-3).floor().long().clamp(0, len(inside))
        last = (begins + grid.cell / edge - 1e-3).ceil().long().clamp(0, len(inside))
        sums = torch.cat([torch.zeros_like(found.narrow(axis, 0, 1)), found.cumsum(axis)], axis)
        found = sums.index_select(axis, last) - sums.index_select(axis, first)
    return found > 0
