"""The leaves of an octree along rays, in order: the reference of `walk.h`.

A grid with coarser ones around it is one of several levels. The finest level shows a point of a ray if
the point is in its box and if a pixel there is at most `CELLS_PER_PIXEL` of its cells wide. So a ray changes levels
where it crosses the faces of boxes, and where its pixel has become too wide. A pixel samples an octree at one position:
without coarser levels, it would show one of many leaves.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor
from torch.nn import functional

from nerfloom.geometry.rays import Rays, Samples
from nerfloom.kernels.octree.layout import BRICK, OCTANT, OctreeLayout

FARTHEST = 2.0**20
"""Maximum coordinate of a ray's origin, in cells; a ray from further away meets no leaf. Seen from there, an octree of
1024 cells covers a pixel. Where float32 does not tell cells apart, a walk could go in circles."""
SMALLEST = 1e-12
"""Minimum magnitude of a direction's coordinate, in cells per scene unit; smaller ones are replaced by it."""
CELLS_PER_PIXEL = 3.0
"""Maximum width of a pixel, in cells; a coarser level shows matter farther away. The cells of that level are a third
to two thirds of a pixel wide. Baked cells are about half as wide as a pixel of the photographs, so views like these are
shown by the finest level alone."""


def smallest_cells(rays: Rays) -> Tensor | None:
    """Return the smallest edge (R,) of cells that show each of R rays, per unit of distance.

    It is None if the rays have no `pixel_radii` or are parallel: the boxes alone then choose the level. A layout of a
    single grid does not use it.
    """
    if rays.pixel_radii is None or rays.parallel:
        return None
    return rays.pixel_radii.detach() * (3**0.5 / CELLS_PER_PIXEL)  # a pixel's radius is 2 / sqrt(12) of its width


def leaf_samples(layout: OctreeLayout, rays: Rays, smallest: Tensor | None = None) -> tuple[Samples, Tensor]:
    """Return the intervals of rays in leaves, ray by ray and in order, and the leaf (N,) int64 of each.

    This is the walk of `walk.h`, with a step of all rays at once.

    Args:
        layout: the places of the leaves.
        rays: R rays of any float type.
        smallest: (R,) smallest edge of cells, per unit of distance (`smallest_cells`); None to choose levels by the
            boxes alone.
    """
    levels, found = layout.levels, list[tuple[Tensor, ...]]()
    lines = [_in_cells(level, rays) for level in levels]
    limits = [*[smallest] * (len(levels) - 1), None]  # nothing is coarser than the last level
    ranges = [_range(level, line, rays, limit) for level, line, limit in zip(levels, lines, limits, strict=True)]
    for index, begin, end in _stretches(ranges):
        found += _walked(levels[index], layout.firsts_of_levels[index], lines[index], begin, end)
    return _in_order(found, len(rays), rays.origins)


def leaf_at(layout: OctreeLayout, positions: Tensor) -> Tensor:
    """Return the leaf (N,) int64 at `positions` (N, 3) in scene units; -1 where `layout` has none.

    With several levels, the finest level with the position in its box has the leaf.
    """
    leaves = torch.full_like(positions[:, 0], -1, dtype=torch.int64)
    unknown = torch.ones_like(leaves, dtype=torch.bool)
    for level, first in zip(layout.levels, layout.firsts_of_levels, strict=False):
        top = BRICK * torch.tensor(level.size, device=positions.device)
        cell = ((positions - level.origin) / level.cell).floor()
        inside = ((cell >= 0) & (cell < top)).all(-1)  # NaN is outside
        found = _block(level, torch.where(inside[:, None], cell, 0).long())[2]
        leaves = torch.where(unknown & inside & (found >= 0), first + found, leaves)
        unknown = unknown & ~inside
    return leaves


Line = tuple[Tensor, Tensor]
"""Origins and directions (R, 3) of rays, in cells of a level."""
Range = tuple[Tensor, Tensor]
"""Distances (R,) where rays begin and end; a ray that does not begin before its end has no range."""


def _in_cells(layout: OctreeLayout, rays: Rays) -> Line:
    place = (rays.origins - layout.origin.to(rays.origins.dtype)) / layout.cell
    along = rays.directions / layout.cell
    return place, torch.where(along.abs() < SMALLEST, torch.full_like(along, SMALLEST).copysign(along), along)


def _range(layout: OctreeLayout, line: Line, rays: Rays, smallest: Tensor | None) -> Range:
    """Return where rays may be shown by a level: in its box, and while its cells are not too small."""
    place, along = line
    top = BRICK * torch.tensor(layout.size, device=place.device)
    sides = torch.stack([-place / along, (top - place) / along])
    begin = torch.maximum(sides.amin(0).amax(-1), rays.nears.to(place)).clamp(min=0)
    end = torch.minimum(sides.amax(0).amin(-1), rays.fars.to(place))
    if smallest is not None:
        end = torch.minimum(end, layout.cell / smallest.to(place))
    usable = ((place.abs() < FARTHEST) & along.isfinite()).all(-1) & (begin < end)
    return torch.where(usable, begin, torch.inf), torch.where(usable, end, -torch.inf)


def _stretches(ranges: Sequence[Range]) -> Iterator[tuple[int, Tensor, Tensor]]:
    """Yield the stretches of rays in each level, front to back: its index, and where they begin and end (R,).

    Args:
        ranges: where each level may show rays; a level's ranges contain the ranges of finer levels.
    """
    nested = list[Range]()
    for begin, end in reversed(ranges):
        known, around = begin < end, nested[-1][1] if nested else end
        # A level that does not show a ray is crossed, so to speak, where the ray leaves the next.
        nested.append((torch.where(known, begin, around), torch.where(known, end, around)))
    nested.reverse()
    for index in range(len(nested) - 1, 0, -1):
        yield index, nested[index][0], torch.minimum(nested[index - 1][0], nested[index][1])
    yield 0, *nested[0]
    for index in range(1, len(nested)):
        yield index, torch.maximum(nested[index - 1][1], nested[index][0]), nested[index][1]


def _walked(layout: OctreeLayout, first: int, line: Line, begin: Tensor, end: Tensor) -> list[tuple[Tensor, ...]]:
    """Return the leaves that rays meet in a level, step by step: indices of rays, leaves, and their ends."""
    place, along = line
    top = BRICK * torch.tensor(layout.size, device=place.device)
    t, far, found = begin.clone(), end, list[tuple[Tensor, ...]]()
    cell = (place + t[:, None] * along).nan_to_num().clamp(min=0).minimum(top - 1.0).long()
    walking = (t < far).nonzero()[:, 0]
    while len(walking):
        here, low, edge, leaf = cell[walking], *_block(layout, cell[walking])
        p, d, now = place[walking], along[walking], t[walking]
        side = low + torch.where(d > 0, edge[:, None], 0)
        exits = (side - p) / d
        reach = torch.maximum(torch.minimum(exits.amin(-1), far[walking]), now)
        met = leaf >= 0
        found.append((walking[met], first + leaf[met], now[met], reach[met]))
        here = torch.maximum(torch.minimum((p + reach[:, None] * d).floor().long(), low + edge[:, None] - 1), low)
        here = torch.where(exits <= reach[:, None], torch.where(d > 0, side, side - 1), here)
        cell[walking], t[walking] = here, reach
        inside = ((here >= 0) & (here < top)).all(-1)
        walking = walking[inside & (reach < far[walking])]
    return found


def _in_order(found: list[tuple[Tensor, ...]], count: int, like: Tensor) -> tuple[Samples, Tensor]:
    if not found:
        none = like.new_zeros(0)
        return Samples(none, none, torch.zeros(count + 1, dtype=torch.int64, device=like.device)), none.long()
    owners, leaves, starts, ends = (torch.cat(part) for part in zip(*found, strict=True))
    order = owners.argsort(stable=True)
    offsets = functional.pad(torch.bincount(owners, minlength=count).cumsum(0), (1, 0))
    return Samples(starts[order], ends[order], offsets), leaves[order]


def _block(layout: OctreeLayout, cell: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the empty block, or the leaf, around cells (M, 3): low corner (M, 3), edge (M,) in cells, leaf or -1."""
    brick, octant, within = cell // BRICK, cell % BRICK // OCTANT, cell % OCTANT
    entry = layout.bricks[brick[:, 0], brick[:, 1], brick[:, 2]].long()
    index = (entry.clamp(min=0), octant[:, 0] + 2 * octant[:, 1] + 4 * octant[:, 2])
    empty = torch.zeros_like(entry)
    mask = torch.where(entry >= 0, layout.masks[index] if len(layout.masks) else empty, empty)
    bit = within[:, 0] + 4 * within[:, 1] + 16 * within[:, 2]
    below = mask[:, None] >> torch.arange(64, device=cell.device) & 1
    rank = (below * (torch.arange(64, device=cell.device) < bit[:, None])).sum(-1)
    is_leaf = below.gather(1, bit[:, None])[:, 0] == 1
    leaf = torch.where(is_leaf, rank + (layout.firsts[index].long() if len(layout.firsts) else empty), -1)
    distance, no_leaves = entry.clamp(max=-1)[:, None], (mask == 0)[:, None]
    low = torch.where(entry[:, None] < 0, (brick + distance + 1) * BRICK, torch.where(no_leaves, cell - within, cell))
    edge = torch.where(entry < 0, (-2 * distance[:, 0] - 1) * BRICK, torch.where(mask == 0, OCTANT, 1))
    return low, edge, leaf
