"""Colours by the reflected viewing direction, for shiny surfaces: Ref-NeRF (Verbin et al. 2022).

The colour of a point is its diffuse colour plus the light around the reflected viewing direction, blurred by the
surface's roughness. That light changes slowly along a surface, so a network learns it more easily than the radiance
along viewing directions. `Reflection` is the part of a field that computes it, from properties of the surface and its
normals. A signed distance has normals. A density's field predicts them, and losses tie them to the density's gradient
(`nerfloom.losses.normals`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from nerfloom.base.config import AT_LEAST_0, Range, TrainConfig
from nerfloom.base.errors import ConfigError
from nerfloom.fields.base import MLP
from nerfloom.geometry.points import Points
from nerfloom.kernels.color import to_srgb
from nerfloom.kernels.encodings.integrated_directional import MAX_BANDS, directional_encoding, num_features
from nerfloom.kernels.math import at_least_float32, safe_normalize

NORMALS, PROPERTIES = slice(1, 4), slice(4, None)
"""Columns of the features of a density's field. The first column is the log-density, or the input of softplus, which
gives the density."""
DIFFUSE, TINT, ROUGHNESS, NUM_PROPERTIES = slice(0, 3), slice(3, 6), 6, 7
"""Columns of the properties of surfaces, and their number. The bottleneck, an input of the directional network, follows
them."""
BOTTLENECK = 16
"""Default number of features of the bottleneck on a hash grid."""
LAYERS = 2
"""Hidden layers of the directional network on a hash grid."""
DIFFUSE_BIAS, ROUGHNESS_BIAS = -3.0, -1.0
"""Added before the activation functions. Roughness starts at a medium value, and diffuse colours start so dim that
reflections learn first. With the paper's -log 3 on a hash grid, diffuse colours learnt everything and reflections
vanished."""


@dataclass(frozen=True)
class DirectionalConfig(TrainConfig):
    """Settings of a method with colours by the viewing direction or by its reflection."""

    directional: Literal["view", "reflected"] = "view"
    """Direction that colours depend on. view: the viewing direction. reflected: the direction that the surface reflects
    to the camera, with the surface's roughness, as in ref-nerf; for shiny things."""


@dataclass(frozen=True)
class PredictedNormalsConfig(TrainConfig):
    """Weights of the penalties on predicted normals (`nerfloom.losses.normals`)."""

    RANGES: ClassVar[dict[str, Range]] = {"normal_loss_mult": AT_LEAST_0, "orientation_loss_mult": AT_LEAST_0}
    normal_loss_mult: float = 3e-3
    """Weight of the difference between predicted normals and the density's normals."""
    orientation_loss_mult: float = 0.1
    """Weight of the penalty on predicted normals that face away from the camera."""


@dataclass(frozen=True)
class DensityDirectionalConfig(DirectionalConfig, PredictedNormalsConfig):
    """Settings of a method with such colours that learns a density."""


class Light(NamedTuple):
    """Light of N points along their rays, linear, and the properties of their surfaces."""

    diffuse: Tensor
    """(N, 3) light that leaves a surface equally in all directions."""
    specular: Tensor
    """(N, 3) reflected light, tinted."""
    roughness: Tensor
    """(N,) inverse concentration of the reflected directions."""
    normals: Tensor
    """(N, 3) unit normals."""

    @property
    def rgb(self) -> Tensor:
        """Display colours (N, 3) in [0, 1]: equation 3 and the transfer function of sRGB."""
        return to_srgb(self.diffuse + self.specular).clamp(max=1)


@runtime_checkable
class HasLight(Protocol):
    """A field with a `Reflection`, or one that may have it. `light` is called only if it has."""

    def light(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Light:
        """Return the light of points.

        Args:
            features: (N, F) features of the points, from `Field.density` or `HasAlpha.alpha`.
            directions: (N, 3) unit viewing directions.
            camera_indices: (N,) training image of each point, as in `Field.color`.
        """


@runtime_checkable
class HasDensityNormals(Protocol):
    """A field that computes the normals of its density, and may predict normals that should equal them."""

    def density_normals(self, points: Points) -> Tensor:
        """Return the outward unit normals (N, 3) of the density, with a gradient; 0 where its own gradient is 0."""


def predicted_normals(features: Tensor) -> Tensor:
    """Return the predicted unit normals (N, 3) of points; 0 for a vector of length 0.

    Args:
        features: (N, F) features of a density's field.
    """
    return safe_normalize(at_least_float32(features[:, NORMALS]))


class Reflection(nn.Module):
    """Light of points from properties of their surfaces, normals and viewing directions: equations 3 to 9.

    Args:
        network: from `num_inputs` features to specular light (N, 3) in [0, 1]. The features are the encoded reflected
            direction, the cosine between normal and viewing direction, 1, the bottleneck, and further ones.
        bottleneck: number B of features of the bottleneck.
        bands: number of bands of the directional encoding.
    """

    def __init__(self, network: nn.Module, bottleneck: int, bands: int = MAX_BANDS) -> None:
        super().__init__()
        self.network, self.bands = network, bands
        self.num_features = 4 + NUM_PROPERTIES + bottleneck
        """Number of features of a density's field."""

    @staticmethod
    def num_inputs(bottleneck: int, bands: int = MAX_BANDS) -> int:
        """Return the number of features that the network takes, without further features.

        Args:
            bottleneck: number of features of the bottleneck.
            bands: number of bands of the directional encoding.
        """
        return num_features(bands) + 2 + bottleneck

    @classmethod
    def small(cls, width: int, bottleneck: int = BOTTLENECK, bands: int = MAX_BANDS, more: int = 0) -> Reflection:
        """Return a part with a small directional network, for a hash grid.

        Args:
            width: features of a hidden layer.
            bottleneck: number of features of the bottleneck.
            bands: number of bands of the directional encoding.
            more: number of further features of each point, such as an image's appearance.

        Raises:
            ConfigError: if the bottleneck has no feature.
        """
        if bottleneck < 1:
            raise ConfigError(f"reflected directions need {1 - bottleneck} more features of positions (--hidden-width)")
        inputs = cls.num_inputs(bottleneck, bands) + more
        return cls(MLP(inputs, *[width] * LAYERS, 3, bias=False, activation="sigmoid"), bottleneck, bands)

    def forward(self, properties: Tensor, normals: Tensor, directions: Tensor, *more: Tensor) -> Light:
        """Return the light of points.

        Args:
            properties: (N, 7 + B) properties of the surfaces, before their activation functions, and the bottleneck.
            normals: (N, 3) unit normals, or 0, which leaves the viewing direction unchanged.
            directions: (N, 3) unit viewing directions.
            more: (N, M) further features.
        """
        roughness = softplus(properties[:, ROUGHNESS] + ROUGHNESS_BIAS)
        away = (normals * directions).sum(-1, keepdim=True)
        reflected = directions - 2 * away * normals
        # The encoding lacks the constant harmonic. Without it a network without biases has no thresholds.
        inputs = directional_encoding(reflected, roughness, self.bands), -away, torch.ones_like(away)
        seen = self.network(*inputs, properties[:, NUM_PROPERTIES:], *more)
        specular = torch.sigmoid(properties[:, TINT]) * at_least_float32(seen)
        return Light(torch.sigmoid(properties[:, DIFFUSE] + DIFFUSE_BIAS), specular, roughness, normals)

    def of_density(self, features: Tensor, directions: Tensor, *more: Tensor) -> Light:
        """Return the light of points with predicted normals.

        Args:
            features: (N, F) features of a density's field.
            directions: (N, 3) unit viewing directions.
            more: (N, M) further features.
        """
        features = at_least_float32(features)
        found: Light = self(features[:, PROPERTIES], predicted_normals(features), directions, *more)
        return found


def reflection_of(config: TrainConfig, width: int, bottleneck: int = BOTTLENECK, more: int = 0) -> Reflection | None:
    """Return the part that `--directional` selects for a hash grid; None for colours by the viewing direction.

    Args:
        width, bottleneck, more: as in `Reflection.small`.
    """
    return Reflection.small(width, bottleneck, more=more) if config.directional == "reflected" else None
