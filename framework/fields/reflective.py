"""Fields of surfaces that reflect: Ref-NeRF (Verbin et al. 2022), on networks and on a hash grid.

The colour of a point is its diffuse colour plus the light around the reflected viewing direction, blurred by the
surface's roughness. That light changes slowly along a surface, so a network learns it more easily than the radiance
along viewing directions. The reflected direction needs normals; a network predicts them, and penalties tie them to the
density's gradient (`nerfloom.fields.normals`).
"""

from __future__ import annotations

import math
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
from nerfloom.kernels.grids.hash_grid_lookup import TableGradient
from nerfloom.kernels.grids.hash_grid_tangent import LOOK_UP
from nerfloom.kernels.math import safe_normalize, split_density
from nerfloom.kernels.networks.mlp import Activation
from nerfloom.kernels.surfaces.distance import distance_network
from nerfloom.kernels.traced.trace import GridDensity

NORMALS, DIFFUSE, TINT, ROUGHNESS = slice(1, 4), slice(4, 7), slice(7, 10), 10
"""Columns of a point's outputs; the first is the log-density, or what softplus makes the density of."""
NUM_OUTPUTS = 11
"""Number of these columns. The bottleneck, which the directional network takes, follows."""
DIFFUSE_BIAS, ROUGHNESS_BIAS = -math.log(3.0), -1.0
"""Added before the activation functions: dim diffuse colours and medium roughness at first (supplement)."""


class Light(NamedTuple):
    """Light of N points along their rays, linear, and the properties of their surfaces."""

    diffuse: Tensor
    """(N, 3) light that leaves a surface in all directions alike."""
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
        network: from `num_inputs(bottleneck)` features to specular light (N, 3) in [0, 1]. Its parts are the encoded
            reflected direction, the cosine between normal and viewing direction, and the bottleneck.
        bands: number of bands of the directional encoding.
    """

    def __init__(self, network: nn.Module, bands: int) -> None:
        super().__init__()
        self.network, self.bands = network, bands

    @staticmethod
    def num_inputs(bottleneck: int, bands: int) -> int:
        """Return the number of features that the network takes."""
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
        specular = torch.sigmoid(outputs[:, TINT]) * seen.float()
        return Light(torch.sigmoid(outputs[:, DIFFUSE] + DIFFUSE_BIAS), specular, roughness, normals)


class ReflectiveField(Field):
    """Base class of fields with reflections. `density` returns the outputs of the spatial network as features.

    In training, the gradient (N, 3) of the log-density, or of another number that rises with the density, follows them.
    """

    reflection: Reflection
    """Computes the light of points."""
    num_outputs: int
    """Number of outputs of the spatial network: 11 with a meaning, and the bottleneck."""

    def light(self, features: Tensor, directions: Tensor) -> Light:
        """Return the light of points.

        Args:
            features: (N, F) features of the points, from `density`.
            directions: (N, 3) unit viewing directions.
        """
        return self.reflection(features[:, : self.num_outputs].float(), directions)

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        return self.light(features, directions).rgb

    def predicted_normals(self, features: Tensor) -> Tensor:
        """Return the predicted unit normals (N, 3) of points from their `features` (N, F)."""
        return safe_normalize(features[:, NORMALS].float())

    def density_normals(self, features: Tensor) -> Tensor:
        """Return the unit normals (N, 3) of the density, with a gradient; 0 where its gradient is 0.

        Args:
            features: (N, F) features of the points, from `density` in training.
        """
        return -safe_normalize(features[:, self.num_outputs :].float())


class ReflectiveGrid(ReflectiveField, BoxField):
    """A hash grid and a network with one hidden layer, whose gradient is learnt from in compiled kernels.

    Args:
        box: (2, 3) corners of the box, scene units.
        encoding: the hash grid.
        reflection: computes the light of points.
        width: features of the hidden layer.
        bottleneck: number of features for the directional network.
        unbounded: whether the grid covers all of space, contracted by `contract_to_unit`.
    """

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
        self.grid, self.reflection, self.num_outputs = encoding, reflection, NUM_OUTPUTS + bottleneck
        self.head = MLP(encoding.num_features, width, self.num_outputs, bias=False)
        if encoding.deferred is not None:  # gradients of this table are those of features and of their derivatives
            encoding.deferred = TableGradient(LOOK_UP, encoding.layout)

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        if not self.training:
            return self.head.density(self.encode(points.positions, None))
        out = self._network(self.unit(points.positions.detach()))
        slopes = self._in_space(points.positions, out[:, self.num_outputs :])
        return split_density(torch.cat([out[:, : self.num_outputs], slopes], dim=-1))

    def grid_density(self) -> GridDensity | None:
        """Return the density for `trace`; None in training, where it would lack the gradient."""
        return None if self.training else self._grid_density(self.head)

    def _network(self, unit: Tensor) -> Tensor:
        """Return outputs (N, D) and the gradient (N, 3) of the first at positions `unit` (N, 3) in the cube."""
        grid = self.grid
        hidden, last = (layer.weight for layer in self.head if isinstance(layer, nn.Linear))
        table, layout, opening = grid.table, grid.layout, grid.opening
        if opening is not None and not opening.complete:
            layout = layout.first(opening.count)
            open_features = layout.num_levels * table.shape[1]
            factors = opening.completed(hidden.new_ones(1, open_features), grid.num_features)
            table, hidden = table[: layout.num_entries], (hidden * factors)[:, :open_features]
        if grid.deferred is not None:
            grid.deferred.layout = layout
        return distance_network(unit, table, hidden, last, layout, grid.deferred)

    def _in_space(self, positions: Tensor, slopes: Tensor) -> Tensor:
        """Return gradients (N, 3) by `positions` (N, 3), scene coordinates, from gradients by those in the cube."""
        if not self.unbounded:
            return slopes * self.scale
        with torch.enable_grad():
            positions = positions.detach().requires_grad_()
            unit = self.unit(positions)
            rows = [torch.autograd.grad(unit[:, a].sum(), positions, retain_graph=True)[0] for a in range(3)]
        return (torch.stack(rows, 1) * slopes[:, :, None]).sum(1)


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
        self.encoding, self.reflection, self.num_outputs = encoding, reflection, NUM_OUTPUTS + bottleneck
        self.network = SkippingNetwork(encoding.num_features, width, depth, depth // 2 + 1, self.num_outputs)

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        if not (self.training and torch.is_grad_enabled()):
            outputs = self.network(self.encoding(points)).float()
        else:
            with derivatives(2):
                points = replace(points, positions=points.positions.detach().requires_grad_())
                outputs = self.network(self.encoding(points)).float()
                (slopes,) = torch.autograd.grad(outputs[:, 0].sum(), points.positions, create_graph=True)
            outputs = torch.cat([outputs, slopes], dim=-1)
        return softplus(outputs[:, 0] + DENSITY_BIAS), outputs
