"""Octrees with fewer and larger leaves, and the coarser levels that show an octree from afar.

A cell of twice the edge stands for eight cells. Rays along an axis cross these in four rows of two cells, and the mean
of the rows' transmittances is the transmittance of the larger cell along this axis. A leaf has one density for all
directions: the density along the axis where it hides most. So a closed surface stays closed in every orientation, a
thin post hides as much as it covers, and the mean depth of thin matter stays the same. The larger cell's colour is the
mean of its cells' colours, weighted by their opacities.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from nerfloom.kernels.octree.layout import BRICK, MAX_LEVELS, OctreeLayout
from nerfloom.kernels.octree.packed import CODES, PackedLeaves
from nerfloom.octrees.octree import Octree
from nerfloom.octrees.packing import packed, packed_depths


def halved(octree: Octree) -> Octree:
    """Return `octree`, of one level, with cells of twice the edge."""
    layout, depths, coefficients = _joined(octree.layout, octree.leaves.depths(), octree.leaves.coefficients())
    return replace(octree, layout=layout, leaves=packed(depths, coefficients)[0])


def with_levels(octree: Octree) -> Octree:
    """Return an octree with coarser levels, down to a single leaf. The finest level stays as it is.

    The octree is as in its file. A box around others keeps its leaves, and gets larger ones from the others.
    """
    leaves, given = octree.leaves, octree.layout.levels
    firsts, levels, parts = octree.layout.firsts_of_levels, list[OctreeLayout](), list[tuple[Tensor, ...]]()
    level, depths, colors = _own(octree, 0)
    while len(levels) < MAX_LEVELS:
        levels.append(level)
        if len(levels) > 1:
            # A coefficient is linear in its byte, so means of bytes are bytes of means, with the same scale and offset.
            parts.append((*packed_depths(depths), colors.round().to(torch.uint8)))
        if level.own_leaves <= 1 and len(levels) >= len(given):
            break
        level, depths, colors = _joined(level, depths, colors)
        if len(levels) < len(given):
            level, depths, colors = _merged((level, depths, colors), _own(octree, len(levels)))
    first = leaves.codes[: firsts[1]], leaves.table[:CODES], leaves.colors[: firsts[1]]
    codes, tables, bytes_ = (torch.cat(each) for each in zip(first, *parts, strict=True))
    leaves = PackedLeaves(codes, tables, bytes_, leaves.scales, leaves.offsets)
    return replace(octree, layout=levels[0].within(levels[1:]), leaves=leaves)


def joined_depths(eighths: Tensor) -> Tensor:
    """Return the optical depth (N,) of the edges of cells: along the axis where their eighths hide most.

    Args:
        eighths: (N, 8) optical depth of the edge of each eighth (x, y, z), at index x + 2 y + 4 z.
    """
    rows = [eighths.view(-1, 2, 2, 2).sum(axis).flatten(1) for axis in (1, 2, 3)]
    along = [math.log(4) - torch.logsumexp(-row, 1) for row in rows]
    return torch.stack(along).amax(0).clamp(min=0)


Level = tuple[OctreeLayout, Tensor, Tensor]
"""A grid of L leaves, the optical depths (L,) of their edges, and values (L, W) that are linear in their colours."""


def _own(octree: Octree, number: int) -> Level:
    """Return a level of an octree by itself, with the bytes of its colours."""
    leaves, firsts = octree.leaves, octree.layout.firsts_of_levels
    part, table = slice(firsts[number], firsts[number + 1]), leaves.table[CODES * number : CODES * (number + 1)]
    return octree.layout.levels[number].within([]), table[leaves.codes[part].long()], leaves.colors[part].float()


def _merged(inner: Level, outer: Level) -> Level:
    """Return the leaves of two grids of equal cells, in the second grid; the first covers a part of its box."""
    shift = ((inner[0].origin - outer[0].origin) / outer[0].cell).round().long()
    cells = torch.cat([inner[0].cells() + shift, outer[0].cells()])
    layout, order = OctreeLayout.build(outer[0].origin, outer[0].cell, outer[0].size, cells)
    return layout, torch.cat([inner[1], outer[1]])[order], torch.cat([inner[2], outer[2]])[order]


def _joined(layout: OctreeLayout, depths: Tensor, values: Tensor) -> Level:
    """Return the level with cells of twice the edge.

    Args:
        layout: the grid of L leaves.
        depths: (L,) optical depth of their edges.
        values: (L, W) values that are linear in their colours.
    """
    cells, (x, y, z) = layout.cells(), ((bricks + 1) // 2 for bricks in layout.size)
    whole, height, width = cells // 2, BRICK * y, BRICK * z
    keys, owner = torch.unique((whole[:, 0] * height + whole[:, 1]) * width + whole[:, 2], return_inverse=True)
    whole = torch.stack([keys // (height * width), keys // width % height, keys % width], -1)
    coarse, order = OctreeLayout.build(layout.origin, 2 * layout.cell, (x, y, z), whole)
    eighths = depths.new_zeros(len(keys), 8)
    eighths[owner, (cells % 2 * cells.new_tensor([1, 2, 4])).sum(-1)] = depths
    deepest = joined_depths(eighths)
    opacities = -torch.expm1(-depths)
    weights = depths.new_zeros(len(keys)).index_add_(0, owner, opacities).clamp(min=1e-9)
    sums = values.new_zeros(len(keys), values.shape[1]).index_add_(0, owner, opacities[:, None] * values)
    return coarse, deepest[order], (sums / weights[:, None])[order]
