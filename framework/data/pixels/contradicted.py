"""Tiles of training images that the other images contradict: people who walk through, shadows, leaves that move.

Where one image shows somebody who is absent from the others, the model shows what is behind that person. Its colours
are then wrong in the same direction throughout a region. Where texture or an edge is not sharp yet, errors are as
large, but their signs differ from pixel to pixel. So each tile keeps a running mean of the signed errors of its drawn
pixels. A tile is contradicted if the square of that mean, averaged over 3 x 3 tiles, is several times the median of all
tiles and exceeds a threshold. No fixed share of pixels is left out: where nothing moves, the means of all tiles become
small.

Finding what moves from errors, and deciding together with neighbours, are ideas of RobustNeRF (Sabour et al. 2023);
counting all pixels at first is one of SpotLessSplats (Sabour et al. 2024).
"""

from __future__ import annotations

import torch
from torch import Tensor

from nerfloom.data.dataset import Dataset
from nerfloom.data.pixels.tiles import Tiles

TILES_ALONG = 12
"""Number of tiles along an image's longer side; fewer if their sides would be shorter than `MIN_SIDE`."""
MIN_SIDE = 4
"""Minimum side of a tile, pixels."""
MEMORY = 32
"""Number of draws in a tile that reduce an error's weight in its mean to 1 / e."""
MIN_DRAWS = 4
"""Number of draws in a tile and its neighbours before it can be contradicted."""
ALL_UNTIL = 0.25
"""Fraction of the budget during which all pixels count, because errors are large everywhere until the scene is
learnt."""
LEAST = 0.07
"""Minimum mean error of a contradicted tile; colours are in [0, 1]."""
STEPS_PER_LOOK = 25
"""Steps between decisions on which tiles are contradicted."""


class ContradictedTiles:
    """Running means of the signed errors in each tile, and the tiles that are contradicted.

    Args:
        dataset: M images.
        factor: a tile is contradicted if its squared mean error is this many times the median.
    """

    def __init__(self, dataset: Dataset, factor: float) -> None:
        self.tiles = Tiles(dataset.cameras, max(round(dataset.scene.image_size / TILES_ALONG), MIN_SIDE))
        self.around, self.factor = self.tiles.neighbours(), factor
        self.state = torch.zeros(self.tiles.total, 5, device=dataset.device)
        """(T, 5) weighted sums of the signed errors of the three channels; sum of the weights; 1 if contradicted,
        otherwise 0."""

    def learn(self, pixels: Tensor, errors: Tensor) -> None:
        """Update the means of tiles.

        Args:
            pixels: (R,) pixels, counted over all images.
            errors: (R, 3) rendered minus true colours; pixels with an error that is not finite are ignored.
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
        """Decide which tiles are contradicted.

        Args:
            progress: fraction of the budget spent, 0 to 1.
        """
        if progress < ALL_UNTIL:
            return
        scores, known = self.scores()
        typical = torch.where(known, scores, torch.nan).nanmedian()
        self.state[:, 4] = known & (scores > (self.factor * typical).clamp(min=LEAST**2))

    @property
    def share(self) -> Tensor:
        """The share () of the tiles that are contradicted."""
        return self.state[:, 4].mean()

    def counting(self, pixels: Tensor) -> Tensor:
        """Return 1 for each of `pixels` (R,) that counts, and 0 for those in contradicted tiles."""
        return 1 - self.state[self.tiles.of(pixels), 4]
