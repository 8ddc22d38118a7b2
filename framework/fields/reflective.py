"""The networks of Ref-NeRF (Verbin et al. 2022), on the integrated encoding of positions."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from nerfloom.encodings.integrated import IntegratedEncoding
from nerfloom.fields.base import MLP, Field
from nerfloom.fields.directional import Light, Reflection
from nerfloom.fields.integrated import DENSITY_BIAS
from nerfloom.geometry.points import Footprint, Points
from nerfloom.kernels.dispatch import derivatives
from nerfloom.kernels.math import at_least_float32, safe_normalize
from nerfloom.kernels.networks.mlp import Activation


class SkippingNetwork(nn.Module):
    """A fully connected network that takes its input again in the middle.

    Args:
        inputs: number of features of the input.
        width: features of a hidden layer.
        depth: number of hidden layers.
        skip: number of hidden layers before the input is concatenated again.
        outputs: number of features of the output.
        activation: activation function of the output.
    """

    def __init__(
        self, inputs: int, width: int, depth: int, skip: int, outputs: int, activation: Activation = "none"
    ) -> None:
        super().__init__()
        self.before = MLP(inputs, *[width] * skip, activation="relu")
        self.after = MLP(width + inputs, *[width] * (depth - skip), outputs, activation=activation)

    def forward(self, *parts: Tensor) -> Tensor:
        """Return the output (N, D) for `parts` (N, D_i), concatenated along their features."""
        return self.after(self.before(*parts), *parts)


class ReflectiveNetworks(Field):
    """A field with reflections, of two networks.

    Args:
        encoding: encoding of points with their size.
        reflection: computes the light of points.
        width: features of a hidden layer (256 in the paper).
        depth: hidden layers (8 in the paper).
    """

    footprint: ClassVar[Footprint] = "gaussian"

    def __init__(self, encoding: IntegratedEncoding, reflection: Reflection, width: int, depth: int) -> None:
        super().__init__()
        self.encoding, self.reflection = encoding, reflection
        self.network = SkippingNetwork(encoding.num_features, width, depth, depth // 2 + 1, reflection.num_features)

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        outputs = at_least_float32(self.network(self.encoding(points)))
        return softplus(outputs[:, 0] + DENSITY_BIAS), outputs

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        return self.light(features, directions).rgb

    def light(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Light:
        """Return the light of points, as `HasLight` does.

        `features` and `directions` are as there; `camera_indices` do not matter, because there are no appearances.
        """
        return self.reflection.of_density(features, directions)

    def density_normals(self, points: Points) -> Tensor:
        """Return the normals of the density, as `HasDensityNormals` does."""
        with torch.enable_grad(), derivatives(2):
            points = replace(points, positions=points.positions.detach().requires_grad_())
            outputs = at_least_float32(self.network(self.encoding(points)))
            (slopes,) = torch.autograd.grad(outputs[:, 0].sum(), points.positions, create_graph=True)
        return -safe_normalize(slopes)
