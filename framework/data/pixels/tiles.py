"""Square tiles of training images, numbered over all images."""

from __future__ import annotations

import torch
from torch import Tensor

from nerfloom.cameras.cameras import Cameras


class Tiles:
    """The tiles of `side` pixels of M images of `cameras`; those at the right and lower borders may be smaller."""

    def __init__(self, cameras: Cameras, side: int) -> None:
        self.cameras, self.side = cameras, side
        self.columns = (cameras.widths + side - 1) // side
        """(M,) number of tiles in a row of each image."""
        counts = self.columns * ((cameras.heights + side - 1) // side)
        ends = counts.cumsum(0)
        self.first = ends - counts
        """(M,) number of each image's first tile."""
        self.total = int(ends[-1])
        """Number T of tiles of all images."""
        self.ends: list[int] = [0, *ends.tolist()]
        """Number of each image's first tile, and T, in Python."""
        self.across: list[int] = self.columns.tolist()
        """`columns` in Python."""

    def of(self, pixels: Tensor) -> Tensor:
        """Return the tile (R,) of each of `pixels` (R,), both counted over all images."""
        cameras = self.cameras
        images = torch.searchsorted(cameras.offsets, pixels, right=True) - 1
        within, widths = pixels - cameras.offsets[images], cameras.widths[images]
        return self.first[images] + within // widths // self.side * self.columns[images] + within % widths // self.side

    def of_image(self, values: Tensor, index: int) -> Tensor:
        """Return the values of the tiles of an image, (rows, columns), in the memory of `values`.

        Args:
            values: (T,) a value of each tile.
            index: number of the image.
        """
        return values[self.ends[index] : self.ends[index + 1]].view(-1, self.across[index])

    def over_image(self, values: Tensor, index: int) -> Tensor:
        """Return the value of the tile of each pixel of an image, (H, W).

        `values` and `index` are as in `of_image`.
        """
        height, width = self.cameras.sizes[index]
        tiles = self.of_image(values, index)
        return tiles.repeat_interleave(self.side, 0)[:height].repeat_interleave(self.side, 1)[:, :width]

    def neighbours(self) -> Tensor:
        """Return the 3 x 3 tiles (T, 9) around each tile; beyond a border, the tile at the border."""
        tiles = torch.arange(self.total, device=self.first.device)
        images = torch.searchsorted(self.first, tiles, right=True) - 1
        first, columns = self.first[images], self.columns[images]
        rows = (self.cameras.heights[images] + self.side - 1) // self.side
        row, column = (tiles - first) // columns, (tiles - first) % columns
        around = [
            first + (row + down).clamp(min=0).minimum(rows - 1) * columns
            + (column + right).clamp(min=0).minimum(columns - 1)
            for down in (-1, 0, 1)
            for right in (-1, 0, 1)
        ]  # fmt: skip
        return torch.stack(around, -1)
