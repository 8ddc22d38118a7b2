"""The cells where a trained model has matter, searched octant by octant, so memory grows with the surface area."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor
from torch.nn import functional

from nerfloom.base.console import track
from nerfloom.export.density import LatticeDensity
from nerfloom.export.lattice import lattice_of
from nerfloom.geometry.bounds import nested_boxes
from nerfloom.kernels.octree.layout import BRICK, OCTANT, OctreeLayout
from nerfloom.octrees.coarser import joined_depths
from nerfloom.octrees.grid import Grid
from nerfloom.renderable import Renderable
from nerfloom.samplers.base import SkipsCells

MIN_DEPTH = 0.01
"""Cells of a smaller optical depth along an edge count as empty."""
PROBES = 4
"""Positions in an octant where the density is evaluated, if the model has no occupancy grid."""
COARSE = 64
"""Octants along the longest edge for finding the box of the matter."""
OCTANTS_AT_ONCE = 4096
"""Number of octants with cells evaluated together."""
MAX_BOXES = 8
"""Maximum number of boxes around one another in an unbounded scene."""
OPAQUE = 20.0
"""Optical depth of the cells of a sky."""


class MatterSearch:
    """A search for a model's matter.

    Args:
        model: the model, in evaluation mode.

    Raises:
        ConfigError: if the model has no density.
    """

    def __init__(self, model: Renderable) -> None:
        self.scene = model.scene
        self.box = model.scene.box.double().cpu()
        # The size of points grows with the cells.
        boxes = nested_boxes(self.box, MAX_BOXES if model.scene.unbounded else 1)
        self._densities = [LatticeDensity(model, lattice_of(box, 512), 1.0) for box in boxes]

    def grids(self, resolution: int) -> list[Grid]:
        """Return the grids to search: the box of all matter or, in an unbounded scene, boxes around one another.

        The largest box ends before rays do. It is at most `resolution` / 4 times as large as the smallest: beyond it,
        all cameras in the smallest box see a point in the same direction, up to about a cell.

        Args:
            resolution: cells along the longest edge.
        """
        if not self.scene.unbounded:
            return [self.tight(resolution)]
        found = [Grid.of(self.box[0], self.box[1], resolution)]
        half = float((self.box[1] - self.box[0]).max()) / 2
        most = min(self.scene.far / (2 * half), resolution / 4, 2.0 ** (MAX_BOXES - 1))
        while 2 ** len(found) <= most:
            found.append(found[-1].around())
        return found

    def tight(self, resolution: int) -> Grid:
        """Return the grid of the box of all matter.

        Args:
            resolution: cells along the longest edge.
        """
        coarse = Grid.of(self.box[0], self.box[1], COARSE * OCTANT)
        octants = self.octants(coarse)
        if not len(octants):
            return Grid.of(self.box[0], self.box[1], resolution)
        low, high = octants.amin(0), octants.amax(0) + 1
        edges = [coarse.origin + coarse.cell * OCTANT * end for end in (low, high)]
        return Grid.of(torch.maximum(edges[0], self.box[0]), torch.minimum(edges[1], self.box[1]), resolution)

    def octants(self, grid: Grid) -> Tensor:
        """Return the octants (N, 3) int64 of a grid that may hold matter."""
        counts = [count * BRICK // OCTANT for count in grid.size]
        occupancy = self._densities[grid.level].grid
        found = self._dense(grid, counts) if occupancy is None else self._in_occupied(grid, counts, occupancy)
        return found.nonzero()

    def _dense(self, grid: Grid, counts: list[int]) -> Tensor:
        """Return whether each octant, or one beside it, is dense at one of a few positions."""
        found = torch.zeros(counts, dtype=torch.bool)
        offsets = torch.rand(PROBES, 3, generator=torch.Generator().manual_seed(0))
        ranges = [torch.arange(count) for count in counts[1:]]
        for x in track(range(counts[0]), "Looking for matter", total=counts[0]):
            slab = torch.cartesian_prod(torch.tensor([x]), *ranges).view(-1, 1, 3)
            positions = grid.positions(((slab + offsets) * OCTANT).reshape(-1, 3))
            sigma = self._densities[grid.level].density(positions).view(-1, PROBES)
            found[x] = (sigma.amax(-1) * grid.cell > MIN_DEPTH).view(counts[1:])
        return functional.max_pool3d(found[None, None].float(), 3, 1, 1)[0, 0] > 0

    def _in_occupied(self, grid: Grid, counts: list[int], occupancy: SkipsCells) -> Tensor:
        """Return whether a cell of the occupancy grid overlaps each octant."""
        # Positions in an octant and on its faces are no further apart than the edge of a cell, so none is missed.
        edge = float((occupancy.box[1] - occupancy.box[0]).min()) / occupancy.resolution * 2**grid.level
        steps = max(math.ceil(OCTANT * grid.cell / edge), 2)
        found = torch.zeros(counts, dtype=torch.bool)
        ranges = [torch.arange(steps * count + 1) for count in counts[1:]]
        shape = [steps + 1, *(len(each) for each in ranges)]
        for x in range(counts[0]):
            slab = torch.cartesian_prod(torch.arange(steps * x, steps * (x + 1) + 1), *ranges)
            kept = self._densities[grid.level].kept(grid.positions(slab * (OCTANT / steps))).view(shape)
            found[x] = functional.max_pool3d(kept[None, None].float(), steps + 1, steps)[0, 0, 0] > 0
        return found

    def cells(self, grid: Grid) -> tuple[Tensor, Tensor]:
        """Return the cells (N, 3) int64 with matter, and the optical depth (N,) of their edges.

        The density is evaluated at a cell's centre. Cells that a smaller grid covers are left out.
        """
        octants, within = self.octants(grid), torch.cartesian_prod(*[torch.arange(OCTANT)] * 3)
        found = [(torch.zeros(0, 3, dtype=torch.int16), torch.zeros(0))]
        for part in _tracked(octants):
            cells = (part[:, None] * OCTANT + within).reshape(-1, 3)
            cells = cells[grid.own(cells)]
            depths = self._densities[grid.level].density(grid.positions(cells + 0.5)) * grid.cell
            kept = depths > MIN_DEPTH
            found.append((cells[kept].to(torch.int16), depths[kept]))
        cells, depths = (torch.cat(parts) for parts in zip(*found, strict=True))
        return cells.long(), depths

    def averaged(self, layout: OctreeLayout, depths: Tensor) -> tuple[Tensor, Tensor]:
        """Return the optical depth (L,) of leaves by the densities of their eighths, and a position (L, 3) of matter.

        A leaf's centre alone aliases: PlenOctrees (Yu et al. 2021, section 3.3) takes the mean of many positions.
        The depth is that of a larger cell for its eighths (`joined_depths`). The position is the mean of the eighths'
        centres, weighted by their opacities.

        Args:
            layout: where the leaves are.
            depths: (L,) their depths, from their centres. Leaves of a sky keep theirs.
        """
        offsets = torch.cartesian_prod(*[torch.tensor([0.25, 0.75])] * 3).flip(1)  # index x + 2 y + 4 z
        found, places = list[Tensor](), list[Tensor]()
        for number, level in enumerate(layout.levels):
            parts = level.cells().split(OCTANTS_AT_ONCE * OCTANT**3 // 8)
            for cells in track(parts, "Averaging leaves", total=len(parts)):
                positions = level.origin + level.cell * (cells[:, None] + offsets)
                sigma = self._densities[number].density(positions.reshape(-1, 3)).view(-1, 8)
                eighths = sigma * (level.cell / 2)
                weights = -torch.expm1(-eighths) + 1e-6
                found.append(joined_depths(eighths))
                places.append((weights[..., None] * positions).sum(1) / weights.sum(1, keepdim=True))
        return torch.where(depths == OPAQUE, depths, torch.cat(found).clamp(min=MIN_DEPTH)), torch.cat(places)

    def layout(self, grids: Sequence[Grid]) -> tuple[OctreeLayout, Tensor]:
        """Return the layout of the cells with matter in some grids, and the optical depth (L,) of their edges.

        Around an unbounded scene without alpha, the cells at the faces of the largest grid are opaque: nobody looks
        through its sky.

        Args:
            grids: the grids, as returned by `grids`.
        """
        levels, found, corner = list[OctreeLayout](), list[Tensor](), grids[0].origin.float()
        for grid in grids:
            cells, depths = self.cells(grid)
            if grid is grids[-1] and self.scene.unbounded and not self.scene.has_alpha:
                sky = grid.surface()
                cells, depths = torch.cat([sky, cells]), torch.cat([torch.full((len(sky),), OPAQUE), depths])
            layout, rows = OctreeLayout.build(corner, grid.cell, grid.size, cells)
            levels.append(layout)
            found.append(depths[rows])
            corner = layout.around()
        return levels[0].within(levels[1:]), torch.cat(found)


def _tracked(octants: Tensor) -> Iterator[Tensor]:
    parts = octants.split(OCTANTS_AT_ONCE)
    yield from track(parts, "Evaluating cells", total=len(parts))
