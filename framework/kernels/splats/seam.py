"""Gaussians on the seam of a panorama: the left edge of the image continues at the right edge."""

from __future__ import annotations

import torch
from torch import Tensor

from nerfloom.kernels.splats.project import Record


def copies(records: Tensor, width: int, turn: float) -> tuple[Tensor, Tensor]:
    """Return copies of Gaussians that a panorama also shows a whole turn to the left or right of their centre.

    A Gaussian that is wider than a turn overlaps its copies. Gradients of a copy go to the Gaussian.

    Args:
        records: (N, RECORD) Gaussians on the image, each at its position nearest to the image's middle.
        width: width of the image, pixels.
        turn: width of a whole turn, pixels.

    Returns:
        Indices (M,) of the Gaussians, and the copies (M, RECORD) of their records.
    """
    x, reach, shown = records[:, Record.X], records[:, Record.REACH_X], records[:, Record.CUT] > 0
    found, moved = [], []
    for shift in (turn, -turn):
        indices = (shown & (x + shift + reach > 0) & (x + shift - reach < width)).nonzero()[:, 0]
        offset = records.new_zeros(records.shape[1])
        offset[Record.X] = shift
        found.append(indices)
        moved.append(records.index_select(0, indices) + offset)
    return torch.cat(found), torch.cat(moved)
