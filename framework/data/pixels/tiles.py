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

    def of(self, pixels: Tensor) -> Tensor:
        """Return the tile (R,) of each of `pixels` (R,), both counted over all images."""
        cameras = self.cameras
        images = torch.searchsorted(cameras.offsets, pixels, right=True) - 1
        within, widths = pixels - cameras.offsets[images], cameras.widths[images]
        return self.first[images] + within // widths // self.side * self.columns[images] + within % widths // self.side

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
