"""The cells that a method samples, as points."""

from __future__ import annotations

import torch
from torch import Tensor

from nerfloom.export.occupancy import innermost
from nerfloom.renderable import Renderable, parts
from nerfloom.samplers.base import SkipsCells

MAX_CELLS = 40_000
"""Maximum number of cells shown."""


def shown_cells(model: Renderable, most: int = MAX_CELLS) -> tuple[Tensor, float] | None:
    """Return centres (N, 3) of occupied cells of a `model` that have an empty neighbour, and the mean edge of a cell.

    Inner cells would not be visible. With nested boxes, the cells of the smallest box are shown. If there are more than
    `most` cells, evenly spaced ones are returned.

    Returns:
        Positions in scene coordinates, and the edge length; None if the method skips no cells.
    """
    samplers = parts(model, SkipsCells)
    if not samplers:
        return None
    sampler = samplers[0]
    grid, box = innermost(sampler), sampler.box.cpu()
    padded = torch.nn.functional.pad(grid, (1, 1, 1, 1, 1, 1))
    inside = grid.clone()
    for axis in range(3):
        for shift in (-1, 1):
            inside &= padded.roll(shift, axis)[1:-1, 1:-1, 1:-1]
    cells = (grid & ~inside).nonzero()
    cells = cells[:: -(-len(cells) // most) or 1]
    edge = (box[1] - box[0]) / sampler.resolution
    return box[0] + (cells + 0.5) * edge, float(edge.mean())
