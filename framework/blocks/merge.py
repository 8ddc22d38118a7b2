"""Gaussians of several blocks merged into one scene, without doubled borders."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import pad

from nerfloom.splats.gaussians import COLUMNS, Gaussians


def merged(parts: Sequence[Gaussians], centers: Tensor) -> Gaussians:
    """Join the Gaussians of blocks. Each block keeps the Gaussians that are nearer to its own centre than to another's.

    So two blocks that have both learned a place do not draw it twice. A Gaussian equally near to two centres belongs to
    the first. Columns that a method added are dropped, and missing degrees of harmonics are 0.

    Args:
        parts: Gaussians of each block, in one frame.
        centers: (B, 3) centres of the blocks in this frame.
    """
    width = max(part.harmonics.shape[2] for part in parts)
    kept = []
    for number, part in enumerate(parts):
        own = of_cell(part, centers, number)
        kept.append(replace(own, harmonics=pad(own.harmonics, (0, width - own.harmonics.shape[2]))))
    return Gaussians.joined(kept)


def of_cell(part: Gaussians, centers: Tensor, number: int) -> Gaussians:
    """Return the Gaussians `part` of the block `number` that it keeps in `merged`, without columns that a method added.

    `centers` (B, 3) are those of all blocks, in the same frame.

    `centers` (B, 3) are those of all blocks, in the same frame.
    """
    own = part[in_cell(part.means, centers, number)]
    return Gaussians.of({name: getattr(own, name) for name in COLUMNS})


def in_cell(points: Tensor, centers: Tensor, number: int) -> Tensor:
    """Return (N,) bool, which of `points` (N, 3) are in the Voronoi cell of the centre `number` of `centers` (B, 3)."""
    points = points.double()
    nearest = torch.full_like(points[:, 0], torch.inf)
    cell = torch.zeros(len(points), dtype=torch.int64, device=points.device)
    for index, center in enumerate(centers.to(points)):  # one at a time, since N may be tens of millions
        distance = (points - center).square().sum(-1)
        cell = torch.where(distance < nearest, index, cell)
        nearest = torch.minimum(nearest, distance)
    return cell == number
