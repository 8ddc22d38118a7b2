"""Square patches of training pixels, for losses that compare a pixel with its neighbours."""

from __future__ import annotations

import torch
from torch import Tensor

from nerfloom.cameras.cameras import Cameras

PATCH = 4
"""Number of pixels along a patch's side."""
PATCHES_ALONG = 25
"""Number of patches along an image's longer side. RobustNeRF (Sabour et al. 2023) has patches of 16 x 16 pixels in
images of about 400. Patches here cover the same area by every 4th row and column: a batch on a CPU holds a few thousand
pixels at most, and whole patches would show too few places."""


def patch_stride(image_side: int) -> int:
    """Return the distance of a patch's pixels.

    Args:
        image_side: longer side of the image, pixels.
    """
    return max(round(image_side / (PATCH * PATCHES_ALONG)), 1)


def patches_around(pixels: Tensor, cameras: Cameras, stride: int = 1) -> Tensor:
    """Return a patch of PATCH x PATCH pixels around each given pixel, which is at a random place in it.

    Patches are moved into their image. An image that is too small repeats its last row or column.

    Args:
        pixels: (N,) int64 numbers of pixels, counted over all images.
        cameras: M cameras of the images.
        stride: distance of a patch's rows and columns, pixels.

    Returns:
        (N * PATCH * PATCH,) int64 pixels, patch after patch, row by row.
    """
    offsets = cameras.offsets.to(pixels.device)
    images = torch.searchsorted(offsets, pixels, right=True) - 1
    widths, heights = (sizes.to(pixels.device)[images] for sizes in (cameras.widths, cameras.heights))
    within = pixels - offsets[images]
    along = stride * torch.arange(PATCH, device=pixels.device)

    def places(center: Tensor, size: Tensor) -> Tensor:
        first = center - stride * torch.randint(PATCH, center.shape, device=center.device)
        first = torch.minimum(first, size - 1 - along[-1]).clamp(min=0)
        return torch.minimum(first[:, None] + along, size[:, None] - 1)

    rows, columns = places(within // widths, heights), places(within % widths, widths)
    return (offsets[images][:, None, None] + rows[:, :, None] * widths[:, None, None] + columns[:, None]).view(-1)
