"""Square patches of training pixels, for losses that compare a pixel with its neighbours."""

from __future__ import annotations

import torch
from torch import Tensor

from nerfloom.cameras.cameras import Cameras

PATCH = 16
"""Side of a patch, pixels, as in RobustNeRF (Sabour et al. 2023)."""


def patches_around(pixels: Tensor, cameras: Cameras) -> Tensor:
    """Return a patch of PATCH x PATCH pixels around each given pixel, which is at a random place in it.

    Patches are moved into their image. An image with a shorter side than PATCH repeats its last row or column.

    Args:
        pixels: (N,) int64 numbers of pixels, counted over all images.
        cameras: M cameras of the images.

    Returns:
        (N * PATCH * PATCH,) int64 pixels, patch after patch, row by row.
    """
    offsets = cameras.offsets.to(pixels.device)
    images = torch.searchsorted(offsets, pixels, right=True) - 1
    widths, heights = (sizes.to(pixels.device)[images] for sizes in (cameras.widths, cameras.heights))
    within = pixels - offsets[images]
    along = torch.arange(PATCH, device=pixels.device)

    def places(center: Tensor, size: Tensor) -> Tensor:
        first = center - torch.randint(PATCH, center.shape, device=center.device)
        first = torch.minimum(first, size - PATCH).clamp(min=0)
        return torch.minimum(first[:, None] + along, size[:, None] - 1)

    rows, columns = places(within // widths, heights), places(within % widths, widths)
    return (offsets[images][:, None, None] + rows[:, :, None] * widths[:, None, None] + columns[:, None]).view(-1)
