"""Octrees with fewer and larger leaves."""

from __future__ import annotations

from dataclasses import replace

import torch

from nerfloom.kernels.octree.layout import BRICK, OctreeLayout
from nerfloom.octrees.octree import Octree
from nerfloom.octrees.packing import packed


def halved(octree: Octree) -> Octree:
    """Return an octree with cells of twice the edge, on the CPU as the given one.

    A cell's density is the mean of its eight cells, empty ones included: the mean optical depth of thin matter stays
    the same. Its colour is their mean, weighted by opacity.

    Args:
        octree: the octree.
    """
    layout, leaves = octree.layout, octree.leaves
    x, y, z = ((bricks + 1) // 2 for bricks in layout.size)
    cells, height, width = layout.cells() // 2, BRICK * y, BRICK * z
    keys, joined = torch.unique((cells[:, 0] * height + cells[:, 1]) * width + cells[:, 2], return_inverse=True)
    cells = torch.stack([keys // (height * width), keys // width % height, keys % width], -1)
    coarse, rows = OctreeLayout.build(layout.origin, 2 * layout.cell, (x, y, z), cells)
    depths, coefficients = leaves.depths(), leaves.coefficients()
    opacities = -torch.expm1(-depths)
    sums = torch.zeros(len(keys)).index_add_(0, joined, depths)
    weights = torch.zeros(len(keys)).index_add_(0, joined, opacities).clamp(min=1e-9)
    colors = torch.zeros(len(keys), coefficients.shape[1])
    colors.index_add_(0, joined, opacities[:, None] * coefficients)
    # Of an edge of twice the length: 2 sums / 8.
    found = packed(sums[rows] / 4, colors[rows] / weights[rows, None])[0]
    return replace(octree, layout=coarse, leaves=found)
