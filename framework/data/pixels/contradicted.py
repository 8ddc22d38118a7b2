"""Tiles of training images that the other images contradict: people who walk through, shadows, leaves that move.

Where one image shows somebody who is absent from the others, the model shows what is behind that person. Its colours
are then wrong in the same direction throughout a region. Where texture or an edge is not sharp yet, errors are as
large, but their signs differ from pixel to pixel. So each tile keeps a running mean of the signed errors of its drawn
pixels. A tile is contradicted if the square of that mean, averaged over 3 x 3 tiles, is several times the median of all
tiles and exceeds a threshold. No fixed share of pixels is left out: where nothing moves, the means of all tiles become
small.

A method that draws whole images sees all errors of an image at once, but each image rarely. There the errors of the
last drawing decide, the median is taken over the image, and errors count less where the photograph has fine structure,
which a model that is not sharp yet misses. The weight of contradicted tiles falls from 1 to 0, so that a part of the
scene that is learnt late is not left out for good.

Finding moving content from errors, and deciding together with neighbours, are ideas of RobustNeRF (Sabour et al. 2023);
counting all pixels at first, and leaving out more and more, are ideas of SpotLessSplats (Sabour et al. 2024).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from nerfloom.data.dataset import Dataset
from nerfloom.data.pixels.left_out import LeftOutTiles

TILES_ALONG = 12
"""Number of tiles along an image's longer side."""
MEMORY = 32
"""Number of draws in a tile that reduce an error's weight in its mean to 1 / e."""
MIN_DRAWS = 4
"""Number of draws in a tile and its neighbours before it can be contradicted."""
ALL_UNTIL = 0.25
"""Fraction of the budget during which all pixels count, because errors are large everywhere until the scene is
learnt."""
FACTOR = 2.0
"""A tile is contradicted if its squared mean error, or its score, is more than this many times the median."""
LEAST = 0.07
"""Minimum mean error of a contradicted tile; colours are in [0, 1]."""
STEPS_PER_LOOK = 25
"""Steps between decisions about contradicted tiles, if batches are pixels."""
FADE = 0.1
"""Time until the weight of contradicted tiles of whole images falls to 1 / e, as a fraction of the budget."""
UNSHARP = 0.5
"""Mean error of a tile, in standard deviations of the photograph's colours there, that a model may have because it is
not sharp yet."""


class ContradictedTiles(LeftOutTiles):
    """Tiles that are contradicted by running means of the signed errors of drawn pixels.

    Args:
        dataset: M images.
    """

    def __init__(self, dataset: Dataset) -> None:
        super().__init__(dataset, TILES_ALONG)
        self.around = self.tiles.neighbours()
        self.state = torch.zeros(self.tiles.total, 5, device=dataset.device)
        """(T, 5) weighted sums of the signed errors of the three channels; sum of the weights; 1 if contradicted,
        otherwise 0."""

    @property
    def left_out(self) -> Tensor:
        return self.state[:, 4]

    def learn(self, pixels: Tensor, errors: Tensor) -> None:
        """Update the means of tiles. Errors that are not finite are ignored.

        `pixels` and `errors` are as in `LeftOutTiles.learn`.
        """
        finite = errors.isfinite().all(-1, keepdim=True)
        drawn = torch.cat([torch.where(finite, errors, 0), finite.to(errors)], -1).to(self.state)
        sums = torch.zeros_like(self.state[:, :4]).index_add_(0, self.tiles.of(pixels), drawn)
        kept = (sums[:, 3:] / -MEMORY).exp()
        self.state[:, :4] = self.state[:, :4] * kept + sums

    def scores(self) -> tuple[Tensor, Tensor]:
        """Return the squared mean error (T,) of each tile, a mean over 3 x 3 tiles, and which (T,) bool are known."""
        sums, drawn = self.state[:, :3], self.state[:, 3]
        squares = (sums / drawn.clamp(min=1e-6)[:, None]).square().mean(-1)
        known = drawn[self.around]
        return (squares[self.around] * known).sum(-1) / known.sum(-1).clamp(min=1e-6), known.sum(-1) >= MIN_DRAWS

    def decide(self, progress: float) -> None:
        if progress < ALL_UNTIL:
            return
        scores, known = self.scores()
        typical = torch.where(known, scores, torch.nan).nanmedian()
        self.state[:, 4] = known & (scores > (FACTOR * typical).clamp(min=LEAST**2))


class ContradictedViews(LeftOutTiles):
    """Tiles of whole images that are contradicted by the errors of the last drawing, by the median of the image.

    Args:
        dataset: M images.
    """

    def __init__(self, dataset: Dataset) -> None:
        super().__init__(dataset, TILES_ALONG)
        self.state = torch.zeros_like(self.state)

    def weights(self, index: int, progress: float) -> Tensor | None:
        """Return the weights (H, W) of the pixels of an image, which fall from 1 to 0 in contradicted tiles.

        `index`, `progress` and None are as in `LeftOutTiles.weights`.
        """
        if progress <= ALL_UNTIL:
            return None
        lost = 1 - math.exp((ALL_UNTIL - progress) / FADE)
        return 1 - lost * self.tiles.over_image(self.left_out, index)

    def learn_view(self, index: int, errors: Tensor, colors: Tensor, progress: float) -> None:
        """Decide which tiles of an image are contradicted. Errors that are not finite count as 0.

        The arguments are as in `LeftOutTiles.learn_view`.
        """
        if progress < ALL_UNTIL:
            return
        scores = view_scores(errors, colors, self.tiles.side)
        out = scores > (FACTOR * scores.median()).clamp(min=LEAST**2)
        self.tiles.of_image(self.state, index).copy_(out)


def view_scores(errors: Tensor, colors: Tensor, side: int) -> Tensor:
    """Return the scores (rows, columns) of the tiles of an image, in the unit of squared errors.

    The score of a tile is its squared mean signed error, times e^2 / (e^2 + (u s)^2) with e = `LEAST`, u = `UNSHARP`
    and the standard deviation s of the photograph's colours in the tile. Scores are averaged over 3 x 3 tiles.

    Args:
        errors: (H, W, 3) drawn minus true colours; values that are not finite count as 0.
        colors: (H, W, 3) true colours.
        side: side of a tile, pixels; tiles at the right and lower borders may be smaller.
    """
    maps = torch.cat([torch.nan_to_num(errors, 0.0, 0.0, 0.0), colors, colors.square()], -1).permute(2, 0, 1)[None]
    error, mean, square = avg_pool2d(maps, side, ceil_mode=True, count_include_pad=False)[0].chunk(3)
    variance = (square - mean.square()).clamp(min=0).mean(0)
    scores = error.square().mean(0) * (LEAST**2 / (LEAST**2 + UNSHARP**2 * variance))
    return avg_pool2d(scores[None, None], 3, stride=1, padding=1, count_include_pad=False)[0, 0]
