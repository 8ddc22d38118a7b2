"""Fields of reflecting surfaces: Ref-NeRF (Verbin et al. 2022), with networks alone and with a hash grid.

The colour of a point is its diffuse colour plus the light around the reflected viewing direction, blurred by the
surface's roughness. That light changes slowly along a surface, so a network learns it more easily than the radiance
along viewing directions. The reflected direction needs normals; a network predicts them, and penalties tie them to the
density's gradient (`nerfloom.fields.normals`).
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import replace
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from nerfloom.encodings.hash_grid import HashGrid
from nerfloom.encodings.integrated import IntegratedEncoding
from nerfloom.fields.base import MLP, Field
from nerfloom.fields.encoded import BoxField
from nerfloom.fields.integrated import DENSITY_BIAS
from nerfloom.geometry.points import Footprint, Points
from nerfloom.kernels.color import to_srgb
from nerfloom.kernels.dispatch import derivatives
from nerfloom.kernels.encodings.integrated_directional import directional_encoding, num_features
from nerfloom.kernels.math import at_least_float32, safe_normalize
from nerfloom.kernels.networks.mlp import Activation
from nerfloom.kernels.traced.trace import GridDensity

NORMALS, DIFFUSE, TINT, ROUGHNESS = slice(1, 4), slice(4, 7), slice(7, 10), 10
"""Columns of a point's outputs. The first column is the log-density, or the input of softplus, which gives the
density."""
NUM_OUTPUTS = 11
"""Number of these columns. The bottleneck, an input of the directional network, follows them."""
DIFFUSE_BIAS, ROUGHNESS_BIAS = -3.0, -1.0
"""Added before the activation functions. Roughness starts at a medium value, and diffuse colours start so dim that
reflections learn first. With the paper's -log 3 on a hash grid, diffuse colours learnt everything and reflections
vanished."""
TAP_DISTANCE = 1 / 512
"""Distance along each axis from a point to the four positions of `ReflectiveGrid`, in shortest edges of the box."""


class Light(NamedTuple):
    """Light of N points along their rays, linear, and the properties of their surfaces."""

    diffuse: Tensor
    """(N, 3) light that leaves a surface equally in all directions."""
    specular: Tensor
    """(N, 3) reflected light, tinted."""
    roughness: Tensor
    """(N,) inverse concentration of the reflected directions."""
    normals: Tensor
    """(N, 3) predicted unit normals."""

    @property
    def rgb(self) -> Tensor:
        """Display colours (N, 3) in [0, 1]: equation 3 and the transfer function of sRGB."""
        return to_srgb(self.diffuse + self.specular).clamp(max=1)


class Reflection(nn.Module):
    """Light of points from the outputs of a spatial network and the viewing direction: equations 3 to 9.

    Args:
        network: from `num_inputs(bottleneck, bands)` features to specular light (N, 3) in [0, 1]. The features are the
            encoded reflected direction, the cosine between normal and viewing direction, and the bottleneck.
        bands: number of bands of the directional encoding.
    """

    def __init__(self, network: nn.Module, bands: int) -> None:
        super().__init__()
        self.network, self.bands = network, bands

    @staticmethod
    def num_inputs(bottleneck: int, bands: int) -> int:
        """Return the number of features that the network takes.

        Args:
            bottleneck: number B of features of the bottleneck.
            bands: number of bands of the directional encoding.
        """
        return num_features(bands) + 1 + bottleneck

    def forward(self, outputs: Tensor, directions: Tensor) -> Light:
        """Return the light of points.

        Args:
            outputs: (N, 11 + B) outputs of the spatial network, with a bottleneck of B features.
            directions: (N, 3) unit viewing directions.
        """
        normals = safe_normalize(outputs[:, NORMALS])
        roughness = softplus(outputs[:, ROUGHNESS] + ROUGHNESS_BIAS)
        away = (normals * directions).sum(-1, keepdim=True)
        reflected = directions - 2 * away * normals
        encoded = directional_encoding(reflected, roughness, self.bands)
        seen = self.network(encoded, -away, outputs[:, NUM_OUTPUTS:].contiguous())
        specular = torch.sigmoid(outputs[:, TINT]) * at_least_float32(seen)
        return Light(torch.sigmoid(outputs[:, DIFFUSE] + DIFFUSE_BIAS), specular, roughness, normals)


class ReflectiveField(Field):
    """Base class of fields with reflections. `density` returns the outputs of the spatial network as features."""

    reflection: Reflection
    """Computes the light of points."""

    @abstractmethod
    def density_normals(self, points: Points) -> Tensor:
        """Return the unit normals (N, 3) of the density, with a gradient; 0 where its gradient is 0.

        Args:
            points: N points.
        """

    def predicted_normals(self, features: Tensor) -> Tensor:
        """Return the predicted unit normals (N, 3) of points from their `features` (N, F)."""
        return safe_normalize(at_least_float32(features[:, NORMALS]))

    def light(self, features: Tensor, directions: Tensor) -> Light:
        """Return the light of points.

        Args:
            features: (N, F) features of the points, from `density`.
            directions: (N, 3) unit viewing directions.
        """
        return self.reflection(at_least_float32(features), directions)

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        return self.light(features, directions).rgb


class ReflectiveGrid(ReflectiveField, BoxField):
    """A hash grid and a network with one hidden layer.

    Its normals are differences of the log-density at four positions around a point, as in Neuralangelo (Li et al. 2023,
    section 3.2). Their gradients need first derivatives only, and the noise of single cells averages out.

    Args:
        box: (2, 3) corners of the box, scene units.
        encoding: the hash grid.
        reflection: computes the light of points.
        width: features of the hidden layer.
        bottleneck: number of features for the directional network.
        unbounded: whether the grid covers all of space, contracted by `contract_to_unit`.
    """

    taps: Tensor

    def __init__(
        self,
        box: Tensor,
        encoding: HashGrid,
        reflection: Reflection,
        width: int,
        bottleneck: int,
        unbounded: bool = False,
    ) -> None:
        super().__init__(box, encoding, unbounded)
        self.reflection = reflection
        self.head = MLP(encoding.num_features, width, NUM_OUTPUTS + bottleneck, bias=False)
        corners = torch.tensor([[1.0, -1, -1], [-1, -1, 1], [-1, 1, -1], [1, 1, 1]])  # of a tetrahedron
        self.register_buffer("taps", TAP_DISTANCE * (box[1] - box[0]).min() * corners.to(box), persistent=False)

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        return self.head.density(self.encode(points.positions, None))

    def grid_density(self) -> GridDensity | None:
        """Return the density for `trace`."""
        return self._grid_density(self.head)

    def density_normals(self, points: Points) -> Tensor:
        around = (points.positions.detach()[:, None] + self.taps).view(-1, 3)
        logs = at_least_float32(self.head(self.encode(around, None))[:, 0]).view(-1, len(self.taps), 1)
        return -safe_normalize((logs * self.taps.sign()).sum(1))


class SkippingNetwork(nn.Module):
    """A fully connected network that takes its input again in the middle.

    Args:
        inputs: number of features of the input.
        width: features of a hidden layer.
        depth: number of hidden layers.
        skip: number of hidden layers after which the input is concatenated again.
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


class ReflectiveNetworks(ReflectiveField):
    """The networks of the paper, on the integrated encoding of positions.

    Args:
        encoding: encoding of points with their size.
        reflection: computes the light of points.
        width: features of a hidden layer (256 in the paper).
        depth: hidden layers (8 in the paper).
        bottleneck: number of features for the directional network (128 in the paper).
    """

    footprint: ClassVar[Footprint] = "gaussian"

    def __init__(
        self, encoding: IntegratedEncoding, reflection: Reflection, width: int, depth: int, bottleneck: int
    ) -> None:
        super().__init__()
        self.encoding, self.reflection = encoding, reflection
        outputs = NUM_OUTPUTS + bottleneck
        self.network = SkippingNetwork(encoding.num_features, width, depth, depth // 2 + 1, outputs)

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        outputs = at_least_float32(self.network(self.encoding(points)))
        return softplus(outputs[:, 0] + DENSITY_BIAS), outputs

    def density_normals(self, points: Points) -> Tensor:
        with torch.enable_grad(), derivatives(2):
            points = replace(points, positions=points.positions.detach().requires_grad_())
            outputs = at_least_float32(self.network(self.encoding(points)))
            (slopes,) = torch.autograd.grad(outputs[:, 0].sum(), points.positions, create_graph=True)
        return -safe_normalize(slopes)
