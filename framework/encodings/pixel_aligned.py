"""Pixel-aligned features: features of positions, looked up in images at the pixels that show the positions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, grid_sample, interpolate, relu

from nerfloom.base.errors import ConfigError
from nerfloom.cameras.cameras import Cameras
from nerfloom.kernels.table_memory import require

MAX_LEVELS = 8
"""Maximum number of levels of an image encoder; a pixel of the eighth is 128 pixels wide."""


@dataclass(frozen=True)
class SourceViews:
    """V images of a scene as feature maps."""

    features: tuple[Tensor, ...]
    """V maps (C, h, w), each covering the whole image at any resolution."""
    cameras: Cameras
    """V cameras of the images."""

    def __len__(self) -> int:
        return len(self.features)

    def in_frames(self, vectors: Tensor, are_points: bool) -> Tensor:
        """Return vectors in the cameras' frames, (V, N, 3).

        Args:
            vectors: (N, 3) positions or directions, scene coordinates.
            are_points: whether they are positions; directions are only rotated.
        """
        poses = self.cameras.camera_to_worlds.to(vectors.dtype)
        moved = vectors - poses[:, None, :, 3] if are_points else vectors.expand(len(self), -1, 3)
        # Products and sums, because autocast would round a matrix product to bfloat16.
        return (poses[:, None, :, :3] * moved[..., None]).sum(-2)

    def aligned(self, points: Tensor) -> Tensor:
        """Return the features at the pixels that show points, (V, N, C): PixelNeRF (Yu et al. 2021), section 4.1.

        Features are interpolated between pixel centres. Positions beyond an image's edge get the features at the edge;
        positions that its camera cannot see (behind it, or outside the lens's reach) get zeros.

        Args:
            points: (N, 3) scene coordinates.
        """
        found = []
        for index, (features, size) in enumerate(zip(self.features, self.cameras.sizes, strict=True)):
            columns, rows, seen = self.cameras.project(points, index)
            places = (torch.stack([columns, rows], dim=-1) + 0.5) / columns.new_tensor(size[::-1]) * 2 - 1
            grid = places.clamp(-2, 2).to(features.dtype)[None, None]
            values = grid_sample(features[None], grid, padding_mode="border", align_corners=False)[0, :, 0]
            found.append(torch.where(seen[:, None], values.T, 0.0))
        return torch.stack(found)


class ImageEncoder(nn.Module):
    """A small convolutional network from images to feature maps: a pyramid with concatenated levels.

    Each level has half the resolution of the one before. PixelNeRF (Yu et al. 2021), section 4.1, concatenates the
    levels of a ResNet pretrained on ImageNet; here each level has two convolutions, trained from scratch. Levels are
    reduced by means of 2 x 2 pixels, so that each feature stays centred on its pixels.

    Args:
        widths: number of features of each level, the finest first.

    Raises:
        ConfigError: if there are no levels or more than `MAX_LEVELS`, if a level has no features, or if the weights
            need more memory than the machine has.
    """

    def __init__(self, widths: Sequence[int]) -> None:
        super().__init__()
        if not 1 <= len(widths) <= MAX_LEVELS or min(widths) < 1:
            raise ConfigError(f"an image encoder has 1 to {MAX_LEVELS} levels of 1 feature or more each")
        require(72.0 * sum(width * max(widths) for width in widths), "an image encoder")
        self.num_features = sum(widths)
        """Number C of features of a pixel."""
        inputs = (3, *widths[:-1])
        self.first = nn.ModuleList(nn.Conv2d(i, o, 3, padding=1) for i, o in zip(inputs, widths, strict=True))
        self.second = nn.ModuleList(nn.Conv2d(width, width, 3, padding=1) for width in widths)
        for layer in (*self.first, *self.second):
            assert isinstance(layer, nn.Conv2d)
            assert layer.bias is not None
            nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
            nn.init.zeros_(layer.bias)

    def forward(self, images: Tensor) -> Tensor:
        """Return the feature maps (V, C, H, W) of images.

        Args:
            images: (V, 3, H, W) colours in [0, 1].
        """
        (height, width), hidden, levels = images.shape[-2:], 2 * images - 1, []
        for level, (first, second) in enumerate(zip(self.first, self.second, strict=True)):
            if level:
                hidden = avg_pool2d(hidden, 2, ceil_mode=True, count_include_pad=False)
            hidden = relu(first(hidden))
            hidden = hidden + relu(second(hidden))
            # Scaled by the exact factor, then cut: for an image of odd size, a level is wider than the image.
            finest = interpolate(hidden.float(), scale_factor=float(2**level), mode="bilinear", align_corners=False)
            levels.append(finest[..., :height, :width])
        return torch.cat(levels, dim=1)
