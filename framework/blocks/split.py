"""Division of cameras into blocks by their positions: by a grid, or by a tree that bounds the images of a block.

Each camera is in one cell. A block has the cameras of its cell and of a margin around it, which its neighbours have
too. Positions, lengths and blocks are in the input's frame and unit.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from nerfloom.blocks.block import Block


class Cell(NamedTuple):
    """A box of a division, and the cameras in it."""

    cameras: Tensor
    """(K,) int64 indices of its cameras, ascending."""
    box: Tensor
    """(2, 3) float64 minimum and maximum corner."""


def grid_blocks(positions: Tensor, edge: float, overlap: float, least: int) -> list[Block]:
    """Divide cameras by a grid of cubes, centred in the cameras' box.

    Args:
        positions: (M, 3) positions of the cameras, M at least 1.
        edge: edge of a cube.
        overlap: share of a block's extent that it has in common with the next one, from 0 to less than 1.
        least: minimum number of images of a block; blocks with fewer are left out.

    Returns:
        The blocks, in the order of their cubes along x, y and z.
    """
    points = positions.double()
    low, high = points.amin(0), points.amax(0)
    counts = ((high - low) / edge).ceil().clamp(min=1)
    start = (low + high - counts * edge) / 2
    places = torch.minimum(((points - start) / edge).floor().clamp(min=0), counts - 1)
    distinct, cell_of = torch.unique(places, dim=0, return_inverse=True)
    corners = start + distinct * edge
    cells = [
        Cell((cell_of == number).nonzero()[:, 0], torch.stack([corner, corner + edge]))
        for number, corner in enumerate(corners)
    ]
    return _blocks(points, cells, overlap, least)


def tree_blocks(positions: Tensor, most: int, overlap: float, least: int) -> list[Block]:
    """Divide cameras by a tree: a box with too many images in its block is cut in two with equally many cameras each.

    A cut is across the axis with the largest spread of the cameras of a box. Cameras at one position cannot be
    divided, so their block may have more images.

    Args:
        positions: (M, 3) positions of the cameras, M at least 1.
        most: maximum number of images of a block, overlap included.
        overlap, least: as in `grid_blocks`.

    Returns:
        The blocks, from the lower to the upper half of each cut.
    """
    points = positions.double()
    cells, waiting = [], [Cell(torch.arange(len(points)), torch.stack([points.amin(0), points.amax(0)]))]
    while waiting:
        cell = waiting.pop()
        halves = None if len(_members(points, cell, overlap)) <= most else _halves(points, cell)
        if halves is None:
            cells.append(cell)
        else:
            waiting += reversed(halves)
    return _blocks(points, cells, overlap, least)


def in_no_block(blocks: Sequence[Block], count: int) -> list[int]:
    """Return the indices, among `count` cameras, of cameras that none of the `blocks` has."""
    covered = {camera for block in blocks for camera in block.cameras}
    return [camera for camera in range(count) if camera not in covered]


def _halves(points: Tensor, cell: Cell) -> list[Cell] | None:
    """Return the two halves of a cell; None if all of its cameras are at one position."""
    own = points[cell.cameras]
    axis = int((own.amax(0) - own.amin(0)).argmax())
    values = own[:, axis].sort().values
    gaps = (values[1:] > values[:-1]).nonzero()[:, 0]
    if not len(gaps):
        return None
    last = int(gaps[(gaps + 1 - len(own) / 2).abs().argmin()])  # of the lower half
    lower = own[:, axis] <= values[last]
    below, above = cell.box.clone(), cell.box.clone()
    below[1, axis] = above[0, axis] = (values[last] + values[last + 1]) / 2
    return [Cell(cell.cameras[lower], below), Cell(cell.cameras[~lower], above)]


def _members(points: Tensor, cell: Cell, overlap: float) -> Tensor:
    """Return the cameras (K,) of a cell and of the margin around it.

    A margin m on both sides of an edge L makes a block of L + 2 m, and two neighbours have 2 m in common.
    """
    margin = overlap / (2 * (1 - overlap)) * (cell.box[1] - cell.box[0])
    inside = ((points >= cell.box[0] - margin) & (points <= cell.box[1] + margin)).all(-1)
    inside[cell.cameras] = True  # despite rounding
    return inside.nonzero()[:, 0]


def _blocks(points: Tensor, cells: Sequence[Cell], overlap: float, least: int) -> list[Block]:
    found = []
    for cell in cells:
        members, center = _members(points, cell, overlap), points[cell.cameras].mean(0)
        reach = (points[members] - center).norm(dim=-1).max()
        radius = float(torch.maximum(reach, (cell.box[1] - cell.box[0]).norm() / 2)) or 1.0
        if len(members) >= least:
            x, y, z = center.tolist()
            found.append(Block((x, y, z), radius, tuple(members.tolist())))
    return found
