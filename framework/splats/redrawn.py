"""Gaussians that do not change between pictures, as while a scene is looked at or evaluated."""

from __future__ import annotations

import torch
from torch import Tensor

from nerfloom.cameras.view import every
from nerfloom.kernels import native
from nerfloom.kernels.splats.packed import PackedGaussians, pack_gaussians, packed_sort_keys, project_packed
from nerfloom.kernels.splats.project import MIN_ALPHA, SplatCamera
from nerfloom.splats.drawing import draw, draw_colors
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.start import morton

MORTON_CELLS = 2**20
"""Cells along an axis by which Gaussians are sorted."""


class Redrawn:
    """Gaussians that are packed when they are drawn for the second time.

    Packing takes as long as a few pictures; after a step of training a viewer draws only one.

    Args:
        gaussians: what is drawn; it must not change.
    """

    def __init__(self, gaussians: Gaussians) -> None:
        self.gaussians = gaussians
        self.packed: PackedGaussians | None = None
        self.pictures = 0

    @torch.no_grad()
    def colors(self, camera: SplatCamera, stride: int, background: Tensor) -> Tensor:
        """Draw the colours (H, W, 3) of a picture.

        Args:
            camera: the whole image.
            stride: distance between the rows and columns that are kept, pixels.
            background: (3,) colour behind everything.
        """
        self.pictures += 1
        if self.pictures == 2 and native.available() and self.gaussians.means.device.type == "cpu":
            self.packed = packed(self.gaussians)
        if self.packed is None:
            return draw_colors(self.gaussians, camera, stride, background)
        records, keys = project_packed(self.packed, camera), packed_sort_keys(self.packed, camera)
        return every(draw(records, camera, background, keys=keys).image, stride)


def packed(gaussians: Gaussians) -> PackedGaussians | None:
    """Return Gaussians packed along a curve through space, without those that no picture shows; None if all are so.

    Args:
        gaussians: N of them, not changed.
    """
    shown = gaussians[gaussians.finite() & (gaussians.rotations.square().sum(1) > 1e-24)]
    shown = shown[torch.sigmoid(shown.logits) > MIN_ALPHA]
    if not len(shown):
        return None
    shown = shown[_along_curve(shown.means)]
    return pack_gaussians(*(getattr(shown, name) for name in vars(shown)))


def _along_curve(means: Tensor) -> Tensor:
    """Return the order (N,) of positions (N, 3) along a curve through the box of all but the farthest hundredths."""
    count = len(means)
    ordered = means.sort(dim=0).values
    low, high = ordered[count // 100], ordered[count - 1 - count // 100]
    cells = (means - low) / (high - low).clamp(min=1e-20) * (MORTON_CELLS - 1)
    return morton(cells.clamp(0, MORTON_CELLS - 1).long()).argsort()
