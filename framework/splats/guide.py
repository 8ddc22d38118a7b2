"""Distances from a field, which supervise Gaussians in the first half of the training."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from nerfloom.data.pixels.batch import ViewBatch

GUIDED_UNTIL = 0.5
"""Share of the budget that uses distances, from the start. Their weight falls linearly to 0."""

GUIDE = {True: (0.1, "captures leave room for floaters"), False: (0.0, "the scene ends at its box")}
"""Weight of a field's distances, and the reason, for unbounded and bounded scenes."""


def guidance(progress: float) -> float:
    """Return the relative weight of the distances, from 1 to 0.

    Args:
        progress: share of the budget that is spent.
    """
    return max(1.0 - progress / GUIDED_UNTIL, 0.0)


class FoundDistances(nn.Module):
    """Distances in some pixels of the training images; none at first. Their number is restored from checkpoints."""

    images: Tensor
    """(K,) int64 image of each pixel."""
    pixels: Tensor
    """(K,) int64 number of the pixel in its image, row by row."""
    distances: Tensor
    """(K,) distance along the ray of the pixel, scene units."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("images", torch.zeros(0, dtype=torch.int64))
        self.register_buffer("pixels", torch.zeros(0, dtype=torch.int64))
        self.register_buffer("distances", torch.zeros(0))

    def __len__(self) -> int:
        return len(self.images)

    def set(self, images: Tensor, pixels: Tensor, distances: Tensor) -> None:
        """Replace the distances.

        Args:
            images: (K,) int64 image of each pixel.
            pixels: (K,) int64 number of the pixel in its image, row by row.
            distances: (K,) distance along the ray of the pixel, scene units.
        """
        self.images, self.pixels, self.distances = images, pixels, distances

    def of_image(self, index: int, height: int, width: int) -> Tensor:
        """Return the distances (H, W) of an image, 0 where unknown.

        Args:
            index: number of the training image.
            height, width: its size, pixels.
        """
        here = self.images == index
        known = self.distances.new_zeros(height * width)
        known[self.pixels[here]] = self.distances[here]
        return known.view(height, width)

    def known(
        self, batch: ViewBatch, progress: float, measured_weight: float, found_weight: float
    ) -> tuple[Tensor | None, float]:
        """Return the target distances (H, W) of an image, 0 where unknown, and their weight; None if there are none.

        Args:
            batch: the image; its measured distances are used if it has some and their weight is not 0.
            progress: share of the budget that is spent.
            measured_weight: weight of measured distances.
            found_weight: initial weight of the field's distances.
        """
        if batch.distances is not None and measured_weight > 0:
            return batch.distances, measured_weight
        weight = found_weight * guidance(progress)
        if weight == 0 or not len(self) or batch.index is None:
            return None, 0.0
        return self.of_image(batch.index, *batch.rgb.shape[:2]), weight

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *rest: Any) -> None:
        for name, buffer in list(self.named_buffers(recurse=False)):
            saved = state_dict.get(prefix + name)
            if saved is None:  # a checkpoint from before there were such distances
                state_dict[prefix + name] = buffer
            elif saved.ndim == 1:
                setattr(self, name, buffer.new_zeros(saved.shape))
        super()._load_from_state_dict(state_dict, prefix, *rest)
