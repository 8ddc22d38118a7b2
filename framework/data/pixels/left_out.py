"""Tiles of training images that training leaves out, because other images contradict them."""

from __future__ import annotations

import torch
from torch import Tensor

from nerfloom.data.dataset import Dataset
from nerfloom.data.pixels.pixel_set import PixelSet
from nerfloom.data.pixels.tiles import Tiles

MIN_SIDE = 4
"""Minimum side of a tile, pixels."""
UNKNOWN = -1.0
"""State of a tile before anything has looked for contradictions."""


class LeftOutTiles:
    """Tiles that do not count. Something else decides which, once; subclasses learn it from errors of training.

    Args:
        dataset: M images.
        along: number of tiles along an image's longer side; fewer if their sides would be shorter than `MIN_SIDE`.
    """

    state: Tensor
    """The state in a checkpoint; here (T,): 1 for tiles that are left out, 0 for others, `UNKNOWN` at first."""

    def __init__(self, dataset: Dataset, along: int) -> None:
        self.tiles = Tiles(dataset.cameras, max(round(dataset.scene.image_size / along), MIN_SIDE))
        self.state = torch.full((self.tiles.total,), UNKNOWN, device=dataset.device)

    @property
    def known(self) -> bool:
        """True if something has decided which tiles are left out."""
        return bool((self.state != UNKNOWN).all())

    @property
    def left_out(self) -> Tensor:
        """(T,) 1 for tiles that are left out, otherwise 0."""
        return self.state.clamp(min=0)

    @property
    def share(self) -> Tensor:
        """The share () of the tiles that are left out."""
        return self.left_out.mean()

    def counting(self, pixels: Tensor) -> Tensor:
        """Return 1 for each of `pixels` (R,), counted over all images, that counts, and 0 for those left out."""
        return 1 - self.left_out[self.tiles.of(pixels)]

    def weights(self, index: int, progress: float) -> Tensor | None:
        """Return the weights (H, W) of the pixels of an image; None if all are 1.

        Args:
            index: number of the image.
            progress: fraction of the budget spent, 0 to 1.
        """
        return 1 - self.tiles.over_image(self.left_out, index)

    def counted(self) -> PixelSet:
        """Return the pixels that count, on the CPU."""
        ends = self.tiles.cameras.ends
        masks = (self.tiles.over_image(self.left_out, index).cpu() == 0 for index in range(len(ends) - 1))
        return PixelSet.joined(PixelSet.of_mask(mask, first) for mask, first in zip(masks, ends, strict=False))

    def learn(self, pixels: Tensor, errors: Tensor) -> None:
        """Learn from the errors of a batch of pixels.

        Args:
            pixels: (R,) pixels, counted over all images.
            errors: (R, 3) rendered minus true colours.
        """

    def learn_view(self, index: int, errors: Tensor, colors: Tensor, progress: float) -> None:
        """Learn from the errors of a whole image.

        Args:
            index: number of the image.
            errors: (H, W, 3) drawn minus true colours.
            colors: (H, W, 3) true colours.
            progress: fraction of the budget spent, 0 to 1.
        """

    def decide(self, progress: float) -> None:
        """Decide which tiles are left out, from the errors of pixels learnt so far.

        Args:
            progress: fraction of the budget spent, 0 to 1.
        """
