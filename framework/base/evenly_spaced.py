"""Evenly spaced indices."""

from __future__ import annotations

import torch
from torch import Tensor


def evenly_spaced(count: int, most: int) -> Tensor:
    """Return at most `most` indices below `count`, (K,) int64, evenly spaced, including the first and the last."""
    # float32 does not represent integers beyond 2^24 exactly, and indices of pixels run over all images.
    return torch.linspace(0, count - 1, min(count, most), dtype=torch.float64).long()


def spread(total: int, limit: int | None) -> list[int]:
    """Return at most `limit` of the numbers 0 to `total` - 1, evenly spaced from 0 on; all if `limit` is None."""
    if limit is None or limit >= total:
        return list(range(total))
    return [index * total // limit for index in range(limit)]
