"""Some of many, equally far apart."""

from __future__ import annotations

import torch
from torch import Tensor


def evenly_spaced(count: int, most: int) -> Tensor:
    """Return at most `most` indices below `count`, evenly spaced, with the first and the last, (K,) int64.

    Args:
        count: number of what is indexed.
        most: maximum number of indices; all are returned if there are no more.
    """
    # In float32 whole numbers beyond 2^24 are not exact, and pixels are counted through all images.
    return torch.linspace(0, count - 1, min(count, most), dtype=torch.float64).long()
