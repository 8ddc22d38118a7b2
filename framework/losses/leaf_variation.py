"""Total variation of values in the leaves of an octree."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional

from nerfloom.kernels.octree.layout import BRICK

SMOOTH = 1e-3
"""Differences well below this have a quadratic penalty, so that the gradient of equal values is 0."""


def leaf_variation(values: Tensor, cells: Tensor) -> Tensor:
    """Return the total variation () of values in leaves: Plenoxels (Fridovich-Keil et al. 2022), equation 3.

    It is the mean over leaves of sqrt(d^2 + SMOOTH^2) - SMOOTH, where d^2 is the sum of the squared differences to the
    next leaf along each axis. Only differences within a brick count, and none to a cell without a leaf.

    Args:
        values: (N, F) values of the leaves.
        cells: (N, 3) int64 coordinates of the leaves, in cells; the leaves of a brick follow each other.
    """
    if not len(cells):
        return values.sum()
    place, inside = cells // BRICK, cells % BRICK
    bricks = functional.pad((place[1:] != place[:-1]).any(-1).long().cumsum(0), (1, 0))
    slots = ((bricks * BRICK + inside[:, 0]) * BRICK + inside[:, 1]) * BRICK + inside[:, 2]
    shape = int(bricks[-1]) + 1, BRICK, BRICK, BRICK
    count = math.prod(shape)
    grid = values.new_zeros(count, values.shape[1]).index_copy(0, slots, values).view(*shape, -1)
    there = torch.zeros(count, dtype=torch.bool, device=cells.device).index_fill_(0, slots, True).view(shape)
    squares = values.new_zeros(shape)
    for axis in (1, 2, 3):
        low, high = grid.narrow(axis, 0, BRICK - 1), grid.narrow(axis, 1, BRICK - 1)
        both = there.narrow(axis, 0, BRICK - 1) & there.narrow(axis, 1, BRICK - 1)
        change = torch.where(both, (high - low).square().sum(-1), 0.0)
        squares = squares + functional.pad(change, [0, 0] * (3 - axis) + [0, 1])
    lengths = (squares + SMOOTH**2).sqrt() - SMOOTH
    return torch.where(there, lengths, 0.0).sum() / len(cells)
