"""Sampling of training pixels in proportion to their error, with weights that keep the expected loss unchanged."""

from __future__ import annotations

import torch
from torch import Tensor

from nerfloom.base.device import to_float64
from nerfloom.data.dataset import Dataset
from nerfloom.data.pixels.tiles import Tiles

TILE = 8
"""Side of the square tiles that share one error, pixels."""
EVENLY = 0.5
"""Uniform fraction of the probability, so that no weight exceeds 2."""
DECAY = 0.8
"""Weight of a tile's old error in an update."""


class ErrorMap:
    """Running mean of the squared error in each tile of 8 x 8 pixels of a data set's images.

    Args:
        dataset: M images.
    """

    def __init__(self, dataset: Dataset) -> None:
        self.tiles = Tiles(dataset.cameras, TILE)
        self.errors = torch.ones(self.tiles.total, device=dataset.device)
        """(T,) mean over a pixel's channels; tiles without a sample have 1, the maximum."""

    def draw(self, candidates: Tensor, count: int) -> tuple[Tensor, Tensor]:
        """Return `count` of the `candidates` (M,) and their loss weights (count,), selected by `choose`."""
        selected, weights = self.choose(candidates, count)
        return candidates[selected], weights

    def choose(self, candidates: Tensor, count: int) -> tuple[Tensor, Tensor]:
        """Select pixels by systematic resampling.

        A candidate's share, with mean 1, determines how often it is selected: count / M times its share on average. Its
        weight is 1 over its share. So the weighted mean of any function over the selected pixels has the mean over all
        candidates as its expectation, whatever the errors.

        Args:
            candidates: (M,) pixels, drawn uniformly.
            count: number of pixels to select.

        Returns:
            Indices of the selected candidates (count,), and weights (count,), at most 1 / EVENLY.
        """
        errors = self.errors[self.tiles.of(candidates)]
        share = EVENLY + (1 - EVENLY) * errors / errors.mean().clamp(min=1e-12)
        ends = to_float64(share).cumsum(0) * (count / len(candidates))
        positions = torch.arange(count, device=ends.device) + torch.rand_like(ends[0])
        selected = torch.searchsorted(ends, positions, right=True).clamp(max=len(candidates) - 1).to(share.device)
        return selected, 1 / share[selected]

    def learn(self, pixels: Tensor, errors: Tensor) -> None:
        """Update the tiles of `pixels` (R,) with their squared `errors` (R,); non-finite errors are ignored."""
        finite, squares = torch.isfinite(errors), self.tiles.of(pixels)
        sums, counts = torch.zeros_like(self.errors), torch.zeros_like(self.errors)
        sums.index_add_(0, squares, torch.where(finite, errors, 0))
        counts.index_add_(0, squares, finite.to(errors))
        total, count, old = sums[squares], counts[squares], self.errors[squares]
        updated = old + (1 - DECAY) * (total / count.clamp(min=1) - old)
        self.errors[squares] = torch.where(count > 0, updated, old)  # equal values for all pixels of a tile
