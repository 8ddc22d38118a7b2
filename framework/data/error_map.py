"""Draw training pixels where the error still is, without changing what the loss is on average."""

from __future__ import annotations

import torch
from torch import Tensor

from framework.base.device import exact
from framework.data.dataset import Dataset

TILE = 8
"""Pixels along an edge of the squares that share one figure."""
EVENLY = 0.5
"""Share of the draws that does not look at the error, so that no weight exceeds 2."""
MEMORY = 0.8
"""What is kept of a square's figure when it is seen again."""


class ErrorMap:
    """The squared error lately seen in each square of 8 x 8 pixels of a data set's photographs.

    Args:
        dataset: M photographs.
    """

    def __init__(self, dataset: Dataset) -> None:
        self.dataset = dataset
        cameras = dataset.cameras
        self.columns = (cameras.widths + TILE - 1) // TILE
        """(M,) squares in a row of each photograph."""
        counts = self.columns * ((cameras.heights + TILE - 1) // TILE)
        self.first = counts.cumsum(0) - counts
        """(M,) each photograph's first square."""
        self.errors = torch.ones(int(counts.sum()), device=dataset.device)
        """Mean over a pixel's channels. What was never seen counts as entirely wrong."""

    def squares(self, pixels: Tensor) -> Tensor:
        """The square of each of the pixels (R,), counted through all photographs."""
        dataset = self.dataset
        images = torch.searchsorted(dataset.cameras.offsets, pixels, right=True) - 1
        within, widths = pixels - dataset.cameras.offsets[images], dataset.cameras.widths[images]
        return self.first[images] + within // widths // TILE * self.columns[images] + within % widths // TILE

    def draw(self, candidates: Tensor, count: int) -> tuple[Tensor, Tensor]:
        """`count` of the candidates (M,), and what to multiply their losses by: see `choose`."""
        taken, weights = self.choose(candidates, count)
        return candidates[taken], weights

    def choose(self, candidates: Tensor, count: int) -> tuple[Tensor, Tensor]:
        """Which `count` of the candidates to take, and what to multiply their losses by.

        Systematic resampling: a candidate is taken count / M times its share on average, its share being 1 in the
        mean; its weight is 1 over that share. So the weighted mean of any function over those taken is, in
        expectation, its mean over all candidates, whatever the errors are.

        Args:
            candidates: (M,) pixels, drawn evenly.
        Returns: places among the candidates (count,) and weights (count,), at most 1 / EVENLY.
        """
        errors = self.errors[self.squares(candidates)]
        share = EVENLY + (1 - EVENLY) * errors / errors.mean().clamp(min=1e-12)
        ends = exact(share).cumsum(0) * (count / len(candidates))
        places = torch.arange(count, device=ends.device) + torch.rand_like(ends[0])
        taken = torch.searchsorted(ends, places, right=True).clamp(max=len(candidates) - 1).to(share.device)
        return taken, 1 / share[taken]

    def learn(self, pixels: Tensor, errors: Tensor) -> None:
        """Remember the squared errors (R,) that the pixels (R,) had; what is not finite is left out."""
        finite = torch.isfinite(errors)
        squares, errors = self.squares(pixels[finite]), errors[finite]
        sums, counts = torch.zeros_like(self.errors), torch.zeros_like(self.errors)
        sums.index_add_(0, squares, errors)
        counts.index_add_(0, squares, torch.ones_like(errors))
        seen = counts > 0
        self.errors[seen] += (1 - MEMORY) * (sums[seen] / counts[seen] - self.errors[seen])
