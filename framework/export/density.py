"""The density of a trained model on a lattice, as its renderer uses it, and the level of its surface."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field

import torch
from torch import Tensor

from nerfloom.base.errors import ConfigError
from nerfloom.export.lattice import Lattice
from nerfloom.geometry.bounds import nested_boxes
from nerfloom.geometry.points import Points
from nerfloom.kernels.march.occupancy import Occupancy
from nerfloom.renderable import HasDensity, HasSignedDistance, Renderable, parts
from nerfloom.samplers.base import SkipsCells

BLOCK = 32
"""Cells along an edge of a block."""
ROUNDING = 1e-3
"""Maximum rounding error of a point, in cells of the occupancy grid."""
CHUNK = 2**16
"""Number of positions that are evaluated at once."""
COARSE = 4
"""Distance in lattice points of the coarse pass, where there is no occupancy grid."""
COARSE_SHARE = 0.01
"""A block is searched if the coarse pass finds this fraction of the level in it."""
LEVEL_SHARE = 1 / 32
"""At the default level, matter of this length is half opaque; a fraction of the longest edge of the scene's box. On
the embedded scene (benchmarks/meshes.py) 1/16 to 1/48 give similar results; a cell of the lattice, 1/256, loses
translucent parts."""


@dataclass
class DensityRange:
    """Statistics of the densities that were evaluated."""

    evaluated: int = 0
    """Number of positions that were evaluated."""
    nan: int = 0
    """Number of positions with a density of NaN."""
    low: float = field(default=math.inf)
    """Minimum of the others."""
    high: float = field(default=-math.inf)
    """Maximum of the others."""

    def add(self, sigma: Tensor) -> None:
        """Count densities `sigma` (N,)."""
        nan = sigma.isnan()
        self.evaluated += len(sigma)
        self.nan += int(nan.sum())
        if not bool(nan.all()):
            known = sigma[~nan]
            self.low, self.high = min(self.low, float(known.min())), max(self.high, float(known.max()))


class LatticeDensity:
    """The density of a model at lattice points: zero in cells that the renderer skips, and evaluated elsewhere.

    Subclasses can evaluate something else.

    Args:
        model: the model in evaluation mode.
        lattice: the points.
        level: density of the surface, 1/scene unit.
        time: time in [0, 1] of a scene that moves.

    Raises:
        ConfigError: if the model has no density.
    """

    quantity = "density"
    """Name of the evaluated quantity, for messages."""
    _skipped = 0.0
    """The value in skipped cells."""

    def __init__(self, model: Renderable, lattice: Lattice, level: float, time: float = 0.0) -> None:
        self._value = self._function(model)
        self._model = model
        self.lattice, self.level, self.time = lattice, level, time
        grids = parts(model, SkipsCells)
        self.grid = grids[0] if grids else None
        self.seen = DensityRange()

    def blocks(self) -> list[Tensor]:
        """Return the blocks (3,) that may hold a part of the surface."""
        return list(self._occupied_blocks() if self.grid is not None else self._coarse_blocks())

    def valued(self, blocks: Iterable[Tensor]) -> Iterator[tuple[Tensor, Tensor]]:
        """Yield `blocks` (3,) with their values for `isosurface`, positive above the level."""
        for block in blocks:
            points, _ = self.lattice.block_points(block, BLOCK)
            sigma = self.density(self.lattice.positions(points).float())
            yield block, self.values_of(sigma)

    def values_of(self, sigma: Tensor) -> Tensor:
        """Return values (N,) in [-1, 1] of densities `sigma` (N,): 0 at the level, positive above it, NaN for NaN."""
        # The values come from the opacity of a length that is half opaque at the level. Densities and their logarithms
        # are unbounded: a vertex between densities of 1 and 10^4 would always lie next to the former.
        return 1 - 2 * torch.exp(-math.log(2) / self.level * sigma)

    def without_surface(self) -> str:
        """Return why there is no surface."""
        seen = self.seen
        if not seen.evaluated:
            return "there is no surface: the occupancy grid has no occupied cell in the box; is the run trained?"
        if seen.nan == seen.evaluated:
            return "there is no surface: the density is NaN everywhere in the box; train the run again"
        return (
            f"there is no surface: the density is between {seen.low:.3g} and {seen.high:.3g} per scene unit in the box "
            f"and never passes {self.level:.4g}; set --isosurface-threshold, or another box"
        )

    @staticmethod
    def _function(model: Renderable) -> Callable[[Points], Tensor]:
        if not isinstance(model, HasDensity):
            raise ConfigError("this method has no density to find a surface in; 'ns-export tsdf' makes a mesh")
        return model.density

    def density(self, positions: Tensor) -> Tensor:
        """Return the density (N,) at `positions` (N, 3) in scene coordinates, on the CPU."""
        if self.grid is None:
            return self._evaluated(positions)
        kept = self.kept(positions).nonzero()[:, 0]
        sigma = torch.full((len(positions),), self._skipped)
        if len(kept):
            sigma[kept] = self._evaluated(positions[kept])
        return sigma

    def kept(self, positions: Tensor) -> Tensor:
        """Return whether the renderer, which must skip cells, samples at `positions` (N, 3), (N,) bool."""
        cells = self._occupancy()
        # The far faces of the box belong to its last cells.
        low, high = cells.outer
        inside = ((positions >= low) & (positions <= high)).all(-1)
        occupied = cells.occupied
        return inside & occupied[cells.cells(positions)]

    def _occupancy(self) -> Occupancy:
        """Return the grid on the CPU, at the time of the density."""
        assert self.grid is not None
        occupied = self.grid.occupied_when(self.time)
        return Occupancy(occupied.cpu(), self.grid.box.cpu(), self.grid.resolution, self.grid.levels)

    @torch.no_grad()
    def _evaluated(self, positions: Tensor) -> Tensor:
        with self._model.rendering():
            found = torch.cat([self._chunk(chunk) for chunk in positions.split(CHUNK)])
        self.seen.add(found)
        return found

    def _chunk(self, positions: Tensor) -> Tensor:
        count, spacing, device = len(positions), self.lattice.spacing, self._model.device
        points = Points(
            positions.to(device),
            torch.full((count,), self.time, device=device) if self._model.scene.moving else None,
            torch.full((count,), spacing / 2, device=device),
        )
        return self._value(points.sized(spacing / 12**0.5)).float().cpu()

    def _occupied_blocks(self) -> Iterator[Tensor]:
        """Yield the blocks that overlap an occupied cell of the grid, by sums over the cells of boxes.

        With nested boxes, uses the cells of the smallest box that contains the whole lattice.
        """
        cells = self._occupancy()
        n, boxes = cells.resolution, nested_boxes(cells.box.double(), cells.levels)
        ends = self.lattice.positions(torch.cartesian_prod(*[torch.tensor([0, count]) for count in self.lattice.cells]))
        holds = [bool(((ends >= low) & (ends <= high)).all()) for low, high in boxes[:-1]]
        level = holds.index(True) if any(holds) else cells.levels - 1
        box, counts = boxes[level], cells.filled[level].to(torch.int32)
        sums = torch.zeros(n + 1, n + 1, n + 1, dtype=torch.int32)
        sums[1:, 1:, 1:] = counts.cumsum(0, dtype=torch.int32).cumsum(1, dtype=torch.int32).cumsum(2, dtype=torch.int32)
        offsets = torch.cartesian_prod(*[torch.tensor([0, BLOCK])] * 3)
        for block in self.lattice.all_blocks(BLOCK):
            corners = (self.lattice.positions(block * BLOCK + offsets) - box[0]) / (box[1] - box[0]) * n
            # A point on the face of a block may be rounded into a cell of the next.
            low = (corners.amin(0) - ROUNDING).floor().clamp(0, n).long().tolist()
            high = ((corners.amax(0) + ROUNDING).floor() + 1).clamp(0, n).long().tolist()
            total = 0
            for choice in range(8):
                corner = [high[a] if choice >> a & 1 else low[a] for a in range(3)]
                sign = -1 if choice.bit_count() % 2 == 0 else 1
                total += sign * int(sums[corner[0], corner[1], corner[2]])
            if total:
                yield block

    def _coarse_blocks(self) -> Iterator[Tensor]:
        """Yield the blocks where the density on a coarser lattice is NaN or near the level."""
        for block in self.lattice.all_blocks(BLOCK):
            points, _ = self.lattice.block_points(block, BLOCK)
            last = torch.tensor(self.lattice.cells)
            kept = ((points % COARSE == 0) | (points == last)).all(-1)
            sigma = self.density(self.lattice.positions(points[kept]).float())
            if self._may_hold(sigma):
                yield block

    def _may_hold(self, sigma: Tensor) -> bool:
        """Return whether a block with these densities on a coarser lattice may hold a part of the surface."""
        return not bool((sigma < COARSE_SHARE * self.level).all())


class LatticeDistance(LatticeDensity):
    """The signed distance of `model` at points of `lattice`; cells that are skipped are outside."""

    quantity = "signed distance"
    _skipped = math.inf

    def __init__(self, model: Renderable, lattice: Lattice) -> None:
        super().__init__(model, lattice, 0.0)

    def without_surface(self) -> str:
        return (
            "there is no surface: the signed distance does not change its sign in the box; train longer, or set "
            "another box"
        )

    @staticmethod
    def _function(model: Renderable) -> Callable[[Points], Tensor]:
        assert isinstance(model, HasSignedDistance)
        return lambda points: model.signed_distance(points)[0]

    def values_of(self, sigma: Tensor) -> Tensor:
        return (-sigma / self.lattice.spacing).clamp(-1, 1)

    def _may_hold(self, sigma: Tensor) -> bool:
        return not bool((sigma > COARSE * 3**0.5 * self.lattice.spacing).all())


def default_level(box: Tensor) -> float:
    """Return the density of the surface, 1/scene unit: matter as long as `LEVEL_SHARE` of the box is half opaque.

    It does not depend on the lattice, so that a finer one shows the same surface in more detail.

    Args:
        box: (2, 3) the scene's box.
    """
    return math.log(2) / (LEVEL_SHARE * float((box[1] - box[0]).max()))
