"""One camera of which a picture is made."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from framework.cameras.cameras import Cameras


@dataclass(frozen=True)
class View:
    """What a picture shows: a camera, a time, and how it is sampled."""

    camera: Cameras
    """One camera: size, pose, lens."""
    time: float | None = None
    """In [0, 1], of a scene that moves."""
    rays_per_pixel: Literal[1, 4, 9, 16] | None = None
    """Rays of which a pixel is the mean; as the method's settings say if None."""
    stride: int = 1
    """Only every so many-th row and column of the pixels is rendered, the first at half of the stride."""

    @classmethod
    def of(cls, cameras: Cameras, index: int, times: Tensor | None = None, stride: int = 1) -> View:
        """Return what camera `index` shows.

        Args:
            cameras: M cameras.
            index: which of them.
            times: (M,) time of each camera; None for a scene that stands still.
            stride: only every so many-th row and column.
        """
        chosen = cameras[torch.tensor([index], device=cameras.fx.device)]
        return cls(chosen, None if times is None else float(times[index]), stride=stride)

    @property
    def height(self) -> int:
        """Height of the picture, pixels."""
        return len(range(self.stride // 2, int(self.camera.heights[0]), self.stride))

    @property
    def width(self) -> int:
        """Width of the picture, pixels."""
        return len(range(self.stride // 2, int(self.camera.widths[0]), self.stride))

    def pixels(self) -> Tensor:
        """Return (height, width) int64, which of the camera's pixels are rendered."""
        grid = self.camera.image_pixels(0).view(int(self.camera.heights[0]), -1)
        return every(grid, self.stride)

    def times(self) -> Tensor | None:
        """Return (1,) the camera's time; None for a scene that stands still."""
        return None if self.time is None else torch.tensor([self.time], device=self.camera.fx.device)


def every(image: Tensor, stride: int) -> Tensor:
    """Return every `stride`-th row and column of an image (H, W, ...), the first being at half of the stride.

    Args:
        image: (H, W, ...).
        stride: 1 for all.
    """
    return image[stride // 2 :: stride, stride // 2 :: stride]
