"""Images of half the size, from which training may begin."""

from __future__ import annotations

import torch
from torch import Tensor


def halved(image: Tensor) -> Tensor:
    """Return an image of half the size, each pixel of which is the mean of four.

    Args:
        image: (H, W, C); an odd last row or column is left out.
    """
    height, width = image.shape[0] // 2 * 2, image.shape[1] // 2 * 2
    return image[:height, :width].reshape(height // 2, 2, width // 2, 2, -1).mean((1, 3))


def halved_distances(distances: Tensor) -> Tensor:
    """Return distances at half the size, the least of four that are known, 0 where none is.

    A mean would lie between what is in front and what is behind; where few pixels are known, none is lost.

    Args:
        distances: (H, W), 0 where unknown; an odd last row or column is left out.
    """
    unknown_far = torch.where(distances > 0, distances, torch.inf)
    least = -torch.nn.functional.max_pool2d(-unknown_far[None], 2)[0]
    return torch.where(least.isfinite(), least, 0)


def doubled(image: Tensor, whole: Tensor) -> Tensor:
    """Return an image of half the size as large as the whole one.

    Args:
        image: (H // 2, W // 2, C) the one of half the size, each pixel of which becomes four.
        whole: (H, W, C) the whole one, from which an odd last row or column is taken.
    """
    out = whole.clone()
    out[: 2 * image.shape[0], : 2 * image.shape[1]] = image.repeat_interleave(2, 0).repeat_interleave(2, 1)
    return out
