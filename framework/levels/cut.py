"""The cut of a tree of Gaussians for a view: the coarsest nodes with an error on the image that is small enough."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from nerfloom.levels.nodes import Nodes


class Cut(NamedTuple):
    """Nodes that show each visible part of the scene once."""

    nodes: list[int]
    """Indices of the nodes, in ascending order."""
    error: float
    """Level error of the cut, pixels."""


def cut_of(nodes: Nodes, sizes: Tensor, seen: Tensor, level_error: float, most: int) -> Cut:
    """Return the nodes that are drawn for a view.

    A node is drawn if its error on the image is at most the level error, or nothing is below it, and no node above it
    is drawn. If these nodes have too many Gaussians, the level error grows to the smallest value with few enough. So a
    smaller limit never leads to a smaller error.

    Args:
        nodes: M nodes.
        sizes: (M,) error of each node on the image, pixels, at most the error of the node above.
        seen: (M,) bool, whether the view may show a node; it may then show the node above, too.
        level_error: requested level error, pixels; 0 for all Gaussians of the leaves.
        most: maximum number of Gaussians, at least the root's number.
    """
    # A node is in the cut of error e if lower <= e < upper.
    lower = torch.where(nodes.is_leaf, -math.inf, sizes)
    upper = nodes.of_parents(sizes, math.inf)
    coarser = lower[seen & (lower > level_error)].unique()
    errors = torch.cat([coarser.new_tensor([level_error]), coarser])
    counts = nodes.counts[seen]
    totals = _total_up_to(errors, lower[seen], counts) - _total_up_to(errors, upper[seen], counts)
    fitting = (totals <= most).nonzero()[:, 0]
    error = errors[fitting[0] if len(fitting) else -1]
    drawn = seen & (lower <= error) & (error < upper)
    return Cut(drawn.nonzero()[:, 0].tolist(), float(error))


def _total_up_to(limits: Tensor, values: Tensor, counts: Tensor) -> Tensor:
    """Return, for each limit, the sum of the counts with a value up to it."""
    order = values.argsort()
    start = values.new_full((1,), -math.inf)  # so that there is a value if there is no node
    sums = torch.cat([counts.new_zeros(1), counts[order]]).cumsum(0)
    return sums[torch.searchsorted(torch.cat([start, values[order]]), limits, right=True) - 1]
