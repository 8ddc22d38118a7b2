"""Few values in place of many: a codebook of numbers, and a palette of vectors, for files of Gaussians.

**A codebook** has 256 numbers, and values become the nearest of them. Half of its numbers are spread evenly over the
range of the values, and half as the values are. So the largest error is at most the range / 255, and it is smaller
where values are dense.

**A palette** is found by k-means (Lloyd 1982) in two levels: vectors are divided into groups, each group into parts.
With K vectors in the palette, a step compares a vector with some 2 sqrt(K) centres instead of K. The start is drawn
with a fixed seed, so the same vectors have the same palette.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

CODES = 256
"""Number of numbers in a codebook."""
STEPS = 8
"""Steps of k-means."""
AT_ONCE = 1 << 24
"""Maximum number of distances held at once."""


def codebook(values: np.ndarray) -> np.ndarray:
    """Return `CODES` numbers, float32 and ascending, for values.

    Args:
        values: finite numbers, at least one, of any shape.
    """
    ordered = np.sort(values.astype(np.float64), axis=None)
    spread = ordered[-1] - ordered[0]
    if spread == 0:
        return np.full(CODES, ordered[0], np.float32)
    share = (ordered - ordered[0]) / spread / 2 + np.linspace(0, 0.5, len(ordered))
    return np.interp(np.linspace(0, 1, CODES), share, ordered).astype(np.float32)


def nearest_codes(values: np.ndarray, codes: np.ndarray) -> np.ndarray:
    """Return the indices, uint8, of the nearest numbers of a codebook, in the shape of the values.

    Args:
        values: numbers of any shape.
        codes: (`CODES`,) ascending.
    """
    exact = codes.astype(np.float64)
    return np.searchsorted((exact[1:] + exact[:-1]) / 2, values).astype(np.uint8)


def palette(vectors: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Return a palette (K, D) and the index (N,) int64 of each vector's entry in it.

    Args:
        vectors: (N, D) float32, finite.
        size: maximum number of entries. If it is at least N, each vector is an entry of its own.
    """
    count = len(vectors)
    if size >= count:
        return vectors, torch.arange(count)
    random = torch.Generator().manual_seed(0)
    _, groups = _means(vectors, math.isqrt(size), random)
    entries, labels, first = list[Tensor](), torch.empty(count, dtype=torch.int64), 0
    members = [(groups == group).nonzero()[:, 0] for group in groups.unique()]
    for rows in members:
        # One entry for each group, and the others by the groups' sizes.
        share = 1 + (size - len(members)) * len(rows) // count
        centers, found = _means(vectors[rows], min(share, len(rows)), random)
        entries.append(centers)
        labels[rows] = first + found
        first += len(centers)
    return torch.cat(entries), labels


def _means(vectors: Tensor, size: int, random: torch.Generator) -> tuple[Tensor, Tensor]:
    """Return the centres (K, D) of k-means, with K = size at most N, and the index (N,) of each vector's nearest."""
    centers = vectors[torch.randperm(len(vectors), generator=random)[:size]]
    for _ in range(STEPS):
        labels = _nearest(vectors, centers)
        sums = torch.zeros(centers.shape, dtype=torch.float64).index_add_(0, labels, vectors.double())
        counts = torch.bincount(labels, minlength=size)[:, None]
        # A centre without vectors stays where it is.
        centers = torch.where(counts > 0, (sums / counts.clamp(min=1)).float(), centers)
    return centers, _nearest(vectors, centers)


def _nearest(vectors: Tensor, centers: Tensor) -> Tensor:
    """Return the index (N,) of the centre that is nearest to each vector."""
    # |v - c|^2 = |v|^2 - 2 (v.c - |c|^2 / 2), and |v| is the same for all centres.
    halves = centers.square().sum(-1) / 2
    parts = vectors.split(max(1, AT_ONCE // len(centers)))
    return torch.cat([(part @ centers.T - halves).argmax(-1) for part in parts])
