"""The leaves of an octree along rays, in order: the reference of `walk.h`."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from nerfloom.geometry.rays import Rays, Samples
from nerfloom.kernels.octree.layout import BRICK, OCTANT, OctreeLayout

FARTHEST = 2.0**20
"""Maximum coordinate of a ray's origin, in cells; a ray from further away meets no leaf. From there an octree of 1024
cells is as large as a pixel. Where float32 does not tell cells apart, a walk could go in circles."""
SMALLEST = 1e-12
"""Minimum magnitude of a direction's coordinate, in cells per scene unit; smaller ones are replaced by it."""


def leaf_samples(layout: OctreeLayout, rays: Rays) -> tuple[Samples, Tensor]:
    """Return the intervals of rays in leaves, ray by ray and in order, and the leaf (N,) int64 of each.

    This is the walk of `walk.h`, with a step of all rays at once.

    Args:
        layout: the places of the leaves.
        rays: R rays of any float type.
    """
    kind, device, count = rays.origins.dtype, rays.origins.device, len(rays)
    place = (rays.origins - layout.origin.to(kind)) / layout.cell
    along = rays.directions / layout.cell
    along = torch.where(along.abs() < SMALLEST, torch.full_like(along, SMALLEST).copysign(along), along)
    top = BRICK * torch.tensor(layout.size, device=device)
    sides = torch.stack([-place / along, (top - place) / along])
    t = torch.maximum(sides.amin(0).amax(-1), rays.nears.to(kind)).clamp(min=0)
    far = torch.minimum(sides.amax(0).amin(-1), rays.fars.to(kind))
    usable = ((place.abs() < FARTHEST) & along.isfinite()).all(-1) & (t < far)
    cell = (place + t[:, None] * along).nan_to_num().clamp(min=0).minimum(top - 1.0).long()
    walking = usable.nonzero()[:, 0]
    found: list[tuple[Tensor, ...]] = []
    while len(walking):
        here, low, edge, leaf = cell[walking], *_block(layout, cell[walking])
        p, d, now = place[walking], along[walking], t[walking]
        side = low + torch.where(d > 0, edge[:, None], 0)
        exits = (side - p) / d
        reach = torch.maximum(torch.minimum(exits.amin(-1), far[walking]), now)
        met = leaf >= 0
        found.append((walking[met], leaf[met], now[met], reach[met]))
        here = torch.maximum(torch.minimum((p + reach[:, None] * d).floor().long(), low + edge[:, None] - 1), low)
        here = torch.where(exits <= reach[:, None], torch.where(d > 0, side, side - 1), here)
        cell[walking], t[walking] = here, reach
        inside = ((here >= 0) & (here < top)).all(-1)
        walking = walking[inside & (reach < far[walking])]
    return _in_order(found, count, place)


def leaf_at(layout: OctreeLayout, positions: Tensor) -> Tensor:
    """Return the leaf (N,) int64 at `positions` (N, 3) in scene units; -1 where `layout` has none."""
    top = BRICK * torch.tensor(layout.size, device=positions.device)
    cell = ((positions - layout.origin) / layout.cell).floor()
    inside = ((cell >= 0) & (cell < top)).all(-1)  # NaN is outside
    found = _block(layout, torch.where(inside[:, None], cell, 0).long())[2]
    return torch.where(inside, found, -1)


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
