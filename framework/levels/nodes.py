"""The nodes of a tree of Gaussians: numbers, boxes and errors, without the Gaussians."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor


class Boxes(NamedTuple):
    """Boxes of the centres of M groups of Gaussians, all in one unit of length."""

    low: Tensor
    """(M, 3) float64 minimum corners."""
    high: Tensor
    """(M, 3) float64 maximum corners."""
    reach: Tensor
    """(M,) float64 maximum distance from its centre where a Gaussian of the group is drawn."""


@dataclass(frozen=True)
class Nodes:
    """M nodes, each behind those below it; the last one is the root. Lengths are in the unit of the file."""

    counts: Tensor
    """(M,) int64 number of Gaussians of each node."""
    parents: Tensor
    """(M,) int64 index of the node above; -1 for the root."""
    low: Tensor
    """(M, 3) float64 minimum corner of a box of the centres of the node's Gaussians and of those below."""
    high: Tensor
    """(M, 3) float64 maximum corner of that box."""
    reach: Tensor
    """(M,) float64 maximum distance from its centre where a Gaussian of the node, or below it, is drawn."""
    errors: Tensor
    """(M,) float64 largest standard deviation of a merged Gaussian of the node; 0 if none is merged."""

    def __len__(self) -> int:
        return len(self.counts)

    @property
    def boxes(self) -> Boxes:
        """The boxes of the nodes, which hold the Gaussians below them, too."""
        return Boxes(self.low, self.high, self.reach)

    @property
    def is_leaf(self) -> Tensor:
        """(M,) bool, whether there is no node below."""
        leaves = torch.ones(len(self), dtype=torch.bool)
        leaves[self.parents[self.parents >= 0]] = False
        return leaves

    def of_parents(self, values: Tensor, of_root: float) -> Tensor:
        """Return the value (M,) of the node above each node, from `values` (M,) of nodes; `of_root` for the root."""
        return torch.where(self.parents >= 0, values[self.parents.clamp(min=0)], of_root)
