"""Gaussians that do not change between pictures, as in a viewer or an evaluation."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from nerfloom.cameras.view import every
from nerfloom.kernels.splats.project import SplatCamera
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.rasteriser import Projected, Rasteriser


class PreparedGaussians:
    """Gaussians that are prepared when they are drawn a second time.

    Preparing takes the time of a few pictures; after a step of training a viewer draws only one.

    Args:
        gaussians: the Gaussians; they must not change.
        time: time of the scene; None for a still scene.
    """

    def __init__(self, gaussians: Gaussians, rasteriser: Rasteriser, time: float | None = None) -> None:
        self.gaussians, self.rasteriser, self.time = gaussians, rasteriser, time
        self.prepared: Callable[[SplatCamera], Projected] | None = None
        self.pictures = 0

    @torch.no_grad()
    def draw(self, camera: SplatCamera, stride: int, background: Tensor) -> tuple[Tensor, Tensor]:
        """Draw the colours of a picture.

        Args:
            camera: the whole image.
            stride: distance between the rows and columns that are kept, pixels.
            background: (3,) colour behind everything.

        Returns:
            Colours (H, W, 3), and the share (H, W) of the background's light that arrives.
        """
        self.pictures += 1
        if self.pictures == 2:
            self.prepared = self.rasteriser.prepared(self.gaussians)
        project = self.prepared or (lambda camera: self.rasteriser.project(self.gaussians, camera))
        drawn = self.rasteriser.draw(project(camera), camera, background)
        return every(drawn.image, stride), every(drawn.transmittance, stride)
