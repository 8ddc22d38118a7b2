"""A view to be rendered: a camera, a time, and the pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from nerfloom.cameras.cameras import Cameras


@dataclass(frozen=True)
class View:
    """A camera, a time, and the pixels and rays that are rendered."""

    camera: Cameras
    """One camera: size, pose, lens."""
    time: float | None = None
    """Time in [0, 1]; None for a static scene."""
    rays_per_pixel: Literal[1, 4, 9, 16] | None = None
    """Number of rays averaged per pixel; if None, the method's setting."""
    stride: int = 1
    """Distance in pixels between rendered rows and columns; the first is at `stride // 2`."""
    scene: int | None = None
    """Index of the scene if the images show several; None for the only one or the first."""
    image: int | None = None
    """Index of a training image, to show its own content too; None: only the content that all images share."""

    @classmethod
    def of(cls, cameras: Cameras, index: int, times: Tensor | None = None, stride: int = 1) -> View:
        """Return the view of camera `index` of M `cameras`, with its time of `times` (M,), if any, at a `stride`."""
        return cls(cameras[index : index + 1], None if times is None else float(times[index]), stride=stride)

    @property
    def height(self) -> int:
        """Height of the rendered image in pixels."""
        return len(range(self.stride // 2, self.camera.sizes[0][0], self.stride))

    @property
    def width(self) -> int:
        """Width of the rendered image in pixels."""
        return len(range(self.stride // 2, self.camera.sizes[0][1], self.stride))

    def pixels(self) -> Tensor:
        """Return the numbers (height, width) int64 of the camera's pixels that are rendered."""
        grid = self.camera.image_pixels(0).view(self.camera.sizes[0][0], -1)
        return every(grid, self.stride)

    def times(self) -> Tensor | None:
        """Return the time of the camera as a tensor (1,); None for a static scene."""
        return None if self.time is None else torch.tensor([self.time], device=self.camera.fx.device)


def every(image: Tensor, stride: int) -> Tensor:
    """Return every `stride`-th row and column of `image` (H, W, ...), starting from row and column `stride // 2`."""
    return image[stride // 2 :: stride, stride // 2 :: stride]
