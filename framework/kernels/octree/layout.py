"""The places of the leaves of a sparse voxel octree.

All leaves are cubes of one size, the cells of a grid over a box. Three of the octree's levels are stored: bricks of 8^3
cells, their octants of 4^3, and cells. A dense grid of bricks says where they are and, in empty space, how far away the
nearest one is, so that a ray crosses empty space in few steps. An octant is a bit set of its cells, as in Laine and
Karras 2010, "Efficient sparse voxel octrees", and the leaves of an octant follow each other.

A grid may have coarser ones around it, each with cells of twice the edge. They show the space outside of its box, and
serve rays where their pixel is much wider than a cell (`walk.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from nerfloom.kernels import native

BRICK, OCTANT = 8, 4
"""Cells along an edge of a brick, and of an octant."""
MAX_DISTANCE = 16
"""Maximum recorded distance to a brick, in bricks."""
MAX_BRICKS = 2**24
"""Maximum number of bricks in the box, empty ones included."""
MAX_LEVELS = 24
"""Maximum number of nested grids, as in `walk.h`."""
BRICKS_AT_ONCE = 2**12
"""Number of bricks that list their cells together; each takes some kilobytes meanwhile."""


class Tables(NamedTuple):
    """The arrays of a layout of V levels, level after level, for kernels that cannot take an array of pointers."""

    frames: Tensor
    """(V, 4) float32 corner of the first cell and a cell's edge, scene units."""
    numbers: Tensor
    """(V, 6) int64 bricks along each axis, and where the level begins in `bricks`, in `masks` and among leaves."""
    bricks: Tensor
    """(X Y Z + ...) int32, as in the layouts; indices count the level's own bricks."""
    masks: Tensor
    """(B, 8) int64."""
    firsts: Tensor
    """(B, 8) int32; indices count the level's own leaves."""


@dataclass(frozen=True)
class OctreeLayout:
    """The leaves of an octree: L cells of a grid, in B bricks. `build` makes one and checks it."""

    origin: Tensor
    """(3,) corner of the first cell, scene units."""
    cell: float
    """Edge of a cell, scene units."""
    bricks: Tensor
    """(X, Y, Z) int32 index of each brick; for an empty one, minus the Chebyshev distance to the nearest, in bricks."""
    masks: Tensor
    """(B, 8) int64 leaves of each octant, bit x + 4 y + 16 z for cell (x, y, z) of octant x + 2 y + 4 z."""
    firsts: Tensor
    """(B, 8) int32 index of the first leaf of each octant."""
    own_leaves: int
    """Number of leaves, without the leaves of coarser grids."""
    coarser: OctreeLayout | None = None
    """The grid with cells of twice the edge around this one; None if there is none. Leaves are numbered grid by grid,
    from the finest."""

    @classmethod
    def build(cls, origin: Tensor, cell: float, size: Sequence[int], cells: Tensor) -> tuple[OctreeLayout, Tensor]:
        """Construct the layout of given leaves.

        Args:
            origin: (3,) corner of the first cell, scene units.
            cell: edge of a cell, scene units.
            size: number of bricks along each axis.
            cells: (N, 3) int64 coordinates of the leaves; repeated ones count once.

        Returns:
            The layout, and the row (L,) of `cells` of each leaf.

        Raises:
            ValueError: if there are too many bricks, or a leaf is outside of them.
        """
        x, y, z = size
        if min(size) < 1 or x * y * z > MAX_BRICKS:
            raise ValueError(f"an octree of {x} x {y} x {z} bricks; there must be 1 to {MAX_BRICKS:,}")
        limit = BRICK * torch.tensor(size, device=cells.device)
        if len(cells) and not bool(((cells >= 0) & (cells < limit)).all()):
            raise ValueError("a leaf is outside of the octree's box")
        within, octant = cells % OCTANT, cells % BRICK // OCTANT
        place = cells // BRICK
        brick = (place[:, 0] * y + place[:, 1]) * z + place[:, 2]
        bit = within[:, 0] + 4 * within[:, 1] + 16 * within[:, 2]
        key = (brick * 8 + octant[:, 0] + 2 * octant[:, 1] + 4 * octant[:, 2]) * 64 + bit
        key, rows = key.sort(stable=True)
        if len(key):
            once = torch.ones_like(key, dtype=torch.bool)
            once[1:] = key[1:] != key[:-1]
            key, rows = key[once], rows[once]
        used, index = torch.unique_consecutive(key // 512, return_inverse=True)
        slot = index * 8 + key // 64 % 8
        masks = key.new_zeros(len(used) * 8).index_add_(0, slot, 1 << (key % 64))
        counts = torch.bincount(slot, minlength=len(used) * 8)
        filled = torch.full((x * y * z,), -1, dtype=torch.int32, device=cells.device)
        filled[used] = torch.arange(len(used), dtype=torch.int32, device=cells.device)
        return cls(
            origin.float().contiguous(),
            float(cell),
            _with_distances(filled.view(x, y, z)),
            masks.view(-1, 8),
            (counts.cumsum(0) - counts).to(torch.int32).view(-1, 8),
            len(key),
        ), rows

    def within(self, coarser: Sequence[OctreeLayout]) -> OctreeLayout:
        """Return the grid with other grids around it.

        Args:
            coarser: the grids, each with cells of twice the edge of the one before; their own `coarser` is replaced.
        """
        return replace(self, coarser=coarser[0].within(coarser[1:]) if coarser else None)

    def part(self, kept: Tensor) -> tuple[OctreeLayout, Tensor]:
        """Return the layout with some of its leaves, and the index (K,) that each of them has here.

        Args:
            kept: (K,) int64 indices of the leaves that are kept, each once.
        """
        found, rows, firsts = list[OctreeLayout](), list[Tensor](), self.firsts_of_levels
        for level, first, end in zip(self.levels, firsts, firsts[1:], strict=False):
            own = kept[(kept >= first) & (kept < end)]
            layout, order = OctreeLayout.build(level.origin, level.cell, level.size, level.cells()[own - first])
            found.append(layout)
            rows.append(own[order])
        return found[0].within(found[1:]), torch.cat(rows)

    def around(self) -> Tensor:
        """Return the corner (3,) of a box with the same centre and twice the edges, scene units."""
        return self.origin - self.cell * BRICK / 2 * torch.tensor(self.size, device=self.origin.device)

    @property
    def num_leaves(self) -> int:
        """Number of leaves of all levels."""
        return self.firsts_of_levels[-1]

    @property
    def levels(self) -> list[OctreeLayout]:
        """The grid itself and the coarser ones, finest first."""
        return [self, *([] if self.coarser is None else self.coarser.levels)]

    @property
    def firsts_of_levels(self) -> list[int]:
        """Index of the first leaf of each grid in `levels`, and the number of all leaves."""
        return [0, *accumulate(level.own_leaves for level in self.levels)]

    def level_of(self, leaves: Tensor) -> Tensor:
        """Return the index (N,) int64 in `levels` of the grid of each of some `leaves` (N,) int64."""
        ends = torch.tensor(self.firsts_of_levels[1:], device=leaves.device)
        return torch.bucketize(leaves, ends, right=True)

    def edges_of(self, leaves: Tensor, kind: torch.dtype) -> Tensor:
        """Return the edge (N,) of each of some `leaves` (N,) int64, scene units, in a float type `kind`."""
        return self.cell * (1 << self.level_of(leaves)).to(kind)

    @property
    def size(self) -> tuple[int, int, int]:
        """Number of bricks along each axis."""
        x, y, z = self.bricks.shape
        return x, y, z

    @property
    def box(self) -> Tensor:
        """The grid's corners (2, 3), scene units."""
        edges = self.cell * BRICK * torch.tensor(self.size, device=self.origin.device)
        return torch.stack([self.origin, self.origin + edges])

    def places(self) -> Tensor:
        """Return the coordinates (B, 3) int64 of the bricks, in bricks."""
        filled = self.bricks >= 0
        places, index = filled.nonzero(), self.bricks[filled].long()
        return torch.empty_like(places).index_copy_(0, index, places)

    def cells(self) -> Tensor:
        """Return the coordinates (L, 3) int64 of the grid's own leaves, in cells."""
        return cells_of(self.places(), self.masks)

    def centers(self) -> Tensor:
        """Return the centres (L, 3) of the leaves of all levels, scene units."""
        return torch.cat([level.origin + level.cell * (level.cells() + 0.5) for level in self.levels])

    def to(self, device: torch.device | str) -> OctreeLayout:
        """Return the layout on `device`."""
        moved = (values.to(device) for values in (self.origin, self.bricks, self.masks, self.firsts))
        origin, bricks, masks, firsts = moved
        coarser = None if self.coarser is None else self.coarser.to(device)
        return OctreeLayout(origin, self.cell, bricks, masks, firsts, self.own_leaves, coarser)

    @cached_property
    def tables(self) -> Tables:
        """The arrays of all levels, level after level."""
        levels, device = self.levels, self.origin.device
        frames = torch.stack([torch.cat([level.origin, level.origin.new_tensor([level.cell])]) for level in levels])
        bricks, masks, firsts = (
            torch.cat([getattr(level, name).view(shape) for level in levels])
            if len(levels) > 1
            else getattr(self, name)
            for name, shape in (("bricks", (-1,)), ("masks", (-1, 8)), ("firsts", (-1, 8)))
        )
        begins = zip(
            accumulate((level.bricks.numel() for level in levels), initial=0),
            accumulate((len(level.masks) for level in levels), initial=0),
            self.firsts_of_levels,
            strict=True,
        )
        rows = [[*level.size, *row] for level, row in zip(levels, begins, strict=False)]
        return Tables(frames, torch.tensor(rows, device=device), bricks, masks, firsts)

    def arguments(self) -> tuple[Any, ...]:
        """Check the layout's arguments of compiled functions and return them."""
        levels = self.levels
        return (
            len(levels), self.cell,
            native.pointers([native.pointer(level.origin, "the origin", (3,)) for level in levels]),
            native.integers(tuple(count for level in levels for count in level.size)),
            native.pointers([native.pointer(level.bricks, "the bricks", level.size, torch.int32) for level in levels]),
            native.pointers([native.pointer(level.masks, "the masks", (len(level.masks), 8), torch.int64)
                             for level in levels]),
            native.pointers([native.pointer(level.firsts, "the octants", (len(level.masks), 8), torch.int32)
                             for level in levels]),
            native.integers(tuple(self.firsts_of_levels)),
        )  # fmt: skip


def cells_of(places: Tensor, masks: Tensor) -> Tensor:
    """Return the coordinates (L, 3) int64 of leaves, in cells and in order.

    Args:
        places: (B, 3) int64 coordinates of bricks, in bricks.
        masks: (B, 8) int64 leaves of their octants, as in `OctreeLayout`.
    """
    bits, found = torch.arange(64, device=masks.device), []
    for some, theirs in zip(places.split(BRICKS_AT_ONCE), masks.split(BRICKS_AT_ONCE), strict=True):
        brick, octant, bit = ((theirs[:, :, None] >> bits) & 1).nonzero().unbind(-1)
        octants = torch.stack([octant & 1, octant >> 1 & 1, octant >> 2], -1)
        within = torch.stack([bit & 3, bit >> 2 & 3, bit >> 4], -1)
        found.append(BRICK * some[brick] + OCTANT * octants + within)
    return torch.cat(found)


def _with_distances(bricks: Tensor) -> Tensor:
    """Return `bricks` (X, Y, Z) with minus the distance to the nearest brick where there is none."""
    filled = bricks >= 0
    near, distance = filled[None, None].float(), filled.new_ones(bricks.shape, dtype=torch.int32)
    for _ in range(MAX_DISTANCE - 1):
        near = functional.max_pool3d(near, 3, 1, 1)
        distance += near[0, 0] == 0
    return torch.where(filled, bricks, -distance).contiguous()
