"""Evenly spaced indices."""

from __future__ import annotations

from fractions import Fraction
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor


def evenly_spaced(count: int, most: int) -> Tensor:
    """Return at most `most` indices below `count`, (K,) int64, evenly spaced, including the first and the last."""
    import torch

    # float32 does not represent integers beyond 2^24 exactly, and indices of pixels run over all images.
    return torch.linspace(0, count - 1, min(count, most), dtype=torch.float64).long()


def evenly_spread(total: int, count: int) -> list[int]:
    """Return `count` of `total` indices at equal distances, including the first and the last.

    Fractions are rounded, and halves to the even integer, as RegNeRF (Niemeyer et al. 2022) and FreeNeRF (Yang et al.
    2023) choose 3, 6 or 9 training images of a capture.

    Args:
        total: number of images, 1 or more.
        count: number of images to choose, 1 or more; all if it is more than `total`.
    """
    if count >= total:
        return list(range(total))
    return [round(Fraction(rank * (total - 1), max(count - 1, 1))) for rank in range(count)]


def strided(total: int, limit: int | None) -> list[int]:
    """Return at most `limit` of the numbers 0 to `total` - 1, evenly spaced from 0 on; all if `limit` is None."""
    if limit is None or limit >= total:
        return list(range(total))
    return [index * total // limit for index in range(limit)]
