"""The field of PixelNeRF (Yu et al. 2021): one network for all scenes, conditioned on images of the scene."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import relu, softplus

from nerfloom.encodings.pixel_aligned import SourceViews
from nerfloom.fields.base import Field
from nerfloom.geometry.points import Points
from nerfloom.kernels.encodings.frequency import frequency_encoding
from nerfloom.kernels.math import at_least_float32
from nerfloom.kernels.table_memory import require


class ResidualBlock(nn.Module):
    """Two layers with a residual connection; initially the identity.

    Args:
        width: number of features.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.inner, self.outer = nn.Linear(width, width), nn.Linear(width, width)
        nn.init.kaiming_normal_(self.inner.weight, nonlinearity="relu")
        nn.init.zeros_(self.inner.bias)
        nn.init.zeros_(self.outer.weight)
        nn.init.zeros_(self.outer.bias)

    def forward(self, hidden: Tensor) -> Tensor:
        """Return features (..., width) of features `hidden` (..., width)."""
        return hidden + self.outer(relu(self.inner(relu(hidden))))


class PixelAlignedField(Field):
    """A field of residual blocks, conditioned on the pixels that show a position: PixelNeRF, section 4.2.

    For each source view, the first blocks take the position in that camera's frame, and each adds the features of the
    pixel that shows it. The mean over views passes through the remaining blocks. So the order of the views and the
    frame of the scene do not matter, and the number of views is free. Unlike in the paper, density does not depend on
    the direction: directions, also in the cameras' frames, are inputs of the colour only.

    Args:
        num_features: number C of features of a pixel.
        unit: length that encoded positions are divided by, scene units.
        width: features of a layer.
        before: residual blocks before the mean over views.
        after: residual blocks after the mean.
        position_frequencies: number of frequencies of encoded positions.

    Raises:
        ConfigError: if the machine has too little memory for the weights.
    """

    def __init__(
        self,
        num_features: int,
        unit: float,
        width: int = 512,
        before: int = 3,
        after: int = 2,
        position_frequencies: int = 6,
    ) -> None:
        super().__init__()
        self.unit, self.position_frequencies = unit, position_frequencies
        self.views: SourceViews | None = None
        """Images of the scene; the caller sets them before evaluation."""
        require(8.0 * (before + after) * width**2, "a network")
        self.lift = nn.Linear(3 + 6 * position_frequencies, width)
        self.conditions = nn.ModuleList(nn.Linear(num_features, width) for _ in range(before))
        self.before = nn.ModuleList(ResidualBlock(width) for _ in range(before))
        self.after = nn.ModuleList(ResidualBlock(width) for _ in range(after))
        self.sigma_head = nn.Linear(width, 1)
        self.color_hidden, self.color_direction = nn.Linear(width, width // 2), nn.Linear(3, width // 2)
        self.color_head = nn.Linear(width // 2, 3)

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        views = self._views()
        local = views.in_frames(points.positions, are_points=True) / self.unit
        hidden = self.lift(frequency_encoding(local, self.position_frequencies))
        pixels = views.aligned(points.positions)
        for condition, block in zip(self.conditions, self.before, strict=True):
            hidden = block(hidden + condition(pixels))
        hidden = hidden.mean(0)
        for block in self.after:
            hidden = block(hidden)
        raw = self.sigma_head(relu(hidden))[:, 0]
        return softplus(at_least_float32(raw) - 1) / self.unit, hidden

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        local = self._views().in_frames(directions, are_points=False)
        hidden = relu(self.color_hidden(relu(features)) + self.color_direction(local)).mean(0)
        return torch.sigmoid(at_least_float32(self.color_head(hidden)))

    def _views(self) -> SourceViews:
        if self.views is None:
            raise ValueError("this field needs images of the scene: set its views first")
        return self.views
