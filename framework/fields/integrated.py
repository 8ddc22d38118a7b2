"""Networks on the integrated encoding, of Mip-NeRF (Barron et al. 2021) and mip-NeRF 360 (Barron et al. 2022)."""

from __future__ import annotations

from typing import ClassVar

from torch import Tensor, nn
from torch.nn.functional import softplus

from nerfloom.encodings.integrated import IntegratedEncoding
from nerfloom.fields.base import MLP, Field
from nerfloom.geometry.points import Footprint, Points
from nerfloom.kernels.encodings.frequency import frequency_encoding
from nerfloom.kernels.networks.mlp import MAX_WIDTH

DENSITY_BIAS = -1.0
"""Added to the density before softplus, so that the scene is half transparent at first (Mip-NeRF, supplement)."""
WIDENING = 1e-3
"""Margin of colours beyond 0 and 1, so that black and white are finite inputs (Mip-NeRF, supplement)."""
BOTTLENECK, COLOR_WIDTH = 256, 128
"""Maximum number of features that the colour network takes in addition to the direction, and of its hidden layer."""


class IntegratedDensity(Field):
    """A field of density without colour, for proposals.

    Args:
        encoding: encoding of points with their size.
        width: features of a hidden layer (256 in the paper).
        depth: hidden layers (4 in the paper).
    """

    footprint: ClassVar[Footprint] = "gaussian"

    def __init__(self, encoding: IntegratedEncoding, width: int = 256, depth: int = 4) -> None:
        super().__init__()
        self.encoding = encoding
        self.network = MLP(encoding.num_features, *[width] * depth, 1)
        self.runs_on_kernels = max(width, encoding.num_features) <= MAX_WIDTH
        _initialise(self)

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        values = self.network(self.encoding(points))
        return softplus(values[:, 0].float() + DENSITY_BIAS), values

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        raise NotImplementedError("a density field has no colours")


class IntegratedField(Field):
    """A field like NeRF's on the integrated encoding: one network for Gaussians of any size.

    Args:
        encoding: encoding of points with their size.
        width: features of a hidden layer (256 in Mip-NeRF, 1024 in mip-NeRF 360).
        depth: hidden layers before density and features.
        skip: number of hidden layers before the encoding is concatenated again.
        direction_frequencies: number of frequencies of the encoded directions.
    """

    footprint: ClassVar[Footprint] = "gaussian"

    def __init__(
        self,
        encoding: IntegratedEncoding,
        width: int = 256,
        depth: int = 8,
        skip: int = 5,
        direction_frequencies: int = 4,
    ) -> None:
        super().__init__()
        self.encoding, self.direction_frequencies = encoding, direction_frequencies
        encoded, bottleneck = encoding.num_features, min(width, BOTTLENECK)
        self.before_skip = MLP(encoded, *[width] * skip, activation="relu")
        self.after_skip = MLP(width + encoded, *[width] * (depth - skip), activation="relu")
        self.sigma_head = MLP(width, 1)
        self.feature_head = MLP(width, bottleneck)
        self.color_head = MLP(
            bottleneck + 3 + 6 * direction_frequencies, max(min(width // 2, COLOR_WIDTH), 1), 3, activation="sigmoid"
        )
        # For larger networks torch's matrix products, on all threads, are faster.
        self.runs_on_kernels = width + encoded <= MAX_WIDTH
        _initialise(self)

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        encoded = self.encoding(points)
        hidden = self.after_skip(self.before_skip(encoded), encoded)
        return softplus(self.sigma_head(hidden)[:, 0].float() + DENSITY_BIAS), hidden

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        encoded = frequency_encoding(directions, self.direction_frequencies)
        rgb = self.color_head(self.feature_head(features), encoded).float()
        return rgb * (1 + 2 * WIDENING) - WIDENING


def _initialise(field: Field) -> None:
    """Set Glorot weights and zero biases, as in the authors' code."""
    for layer in field.modules():
        if isinstance(layer, nn.Linear):
            nn.init.xavier_uniform_(layer.weight)
            nn.init.zeros_(layer.bias)
