"""Leaves that become smaller and fewer during training: when, which stay, and their eighths."""

from __future__ import annotations

import torch
from torch import Tensor

from nerfloom.kernels.octree.layout import OctreeLayout

UNMET = -1.0
"""Largest weight of a leaf that no ray has met and that stays, because nothing is known of it."""


def moments(num_splits: int) -> list[tuple[float, bool]]:
    """Return when leaves change: spent shares of the budget, each with whether leaves are split or only dropped.

    Each size of leaves lasts twice the time of the one before. Leaves are dropped in the middle and at the end of this
    time, except at the end of training.

    Args:
        num_splits: number of splits.
    """
    found, total = list[tuple[float, bool]](), 2 ** (num_splits + 1) - 1
    for level in range(num_splits + 1):
        begin, length = (2**level - 1) / total, 2**level / total
        found += [(begin + length / 2, False), (begin + length, True)]
    return found[:-1]


def visible(peaks: Tensor, least: float, most: int) -> Tensor:
    """Return the leaves (K,) int64 that stay, in ascending order.

    A ray over colours in [0, 1] changes by at most the sum of the weights that the dropped leaves have on it.

    Args:
        peaks: (L,) largest weight of each leaf on training rays, or `UNMET`; such leaves stay.
        least: smallest weight of a visible leaf. If no leaf has it, nothing is known yet, and all qualify.
        most: maximum number of leaves; those with the largest weights stay.
    """
    seen = peaks >= least
    kept = (seen | (peaks < 0) | ~seen.any()).nonzero()[:, 0]
    return kept if len(kept) <= most else kept[peaks[kept].topk(most).indices].sort().values


def split(layout: OctreeLayout, cells: Tensor) -> tuple[OctreeLayout, Tensor]:
    """Return the layout with the eighths of some cells as leaves.

    Args:
        layout: the grid of the cells.
        cells: (K, 3) int64 coordinates of the cells.

    Returns:
        The layout of 8 K leaves, and the index (8 K,) in `cells` of the cell that each leaf is a part of.
    """
    offsets = torch.cartesian_prod(*[torch.arange(2, device=cells.device)] * 3)
    parts = (2 * cells[:, None] + offsets).reshape(-1, 3)
    size = [2 * count for count in layout.size]
    finer, rows = OctreeLayout.build(layout.origin, layout.cell / 2, size, parts)
    return finer, rows // len(offsets)
