"""Images of half the size, from which training may begin."""

from __future__ import annotations

from torch import Tensor


def halved(image: Tensor) -> Tensor:
    """Return an image of half the size, each pixel of which is the mean of four.

    Args:
        image: (H, W, C); an odd last row or column is left out.
    """
    height, width = image.shape[0] // 2 * 2, image.shape[1] // 2 * 2
    return image[:height, :width].reshape(height // 2, 2, width // 2, 2, -1).mean((1, 3))


def doubled(image: Tensor, whole: Tensor) -> Tensor:
    """Return an image of half the size as large as the whole one.

    Args:
        image: (H // 2, W // 2, C) the one of half the size, each pixel of which becomes four.
        whole: (H, W, C) the whole one, from which an odd last row or column is taken.
    """
    out = whole.clone()
    out[: 2 * image.shape[0], : 2 * image.shape[1]] = image.repeat_interleave(2, 0).repeat_interleave(2, 1)
    return out
