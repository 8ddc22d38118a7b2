"""The interface of fields, and the small network that most of them use."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from itertools import pairwise
from typing import ClassVar, Protocol, runtime_checkable

from torch import Tensor, nn

from nerfloom.base.errors import ConfigError, shown
from nerfloom.base.optimised import Optimised
from nerfloom.geometry.points import Footprint, Points
from nerfloom.kernels.networks.mlp import Activation, density_mlp, mlp
from nerfloom.kernels.table_memory import require
from nerfloom.kernels.traced.colors import GridColor
from nerfloom.kernels.traced.trace import GridDensity

DensityFunction = Callable[[Points], tuple[Tensor, Tensor]]
"""Function from N points to density (N,), 1/length, and features (N, F). Samplers take it as an argument."""


class Field(nn.Module, ABC):
    """Base class of fields. Density and colour are two methods, so that a sampler can compute the density only."""

    footprint: ClassVar[Footprint] = "none"
    """Size of points that `density` needs."""
    optimised: Optimised | None = None
    """Optimiser settings of its parameters; if None, the model's."""
    unbounded: bool = False
    """True if it covers all of space, contracted around a box."""
    runs_on_kernels: bool = False
    """True if compiled kernels do most of its work; torch's own operations then use one CPU thread."""

    @abstractmethod
    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        """Return the density at points.

        Args:
            points: N points, with the size that `footprint` names; N may be 0.

        Returns:
            density (N,), float32, at least 0, in 1/length, and features (N, F) for `color`.
        """

    @abstractmethod
    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        """Return the colour (N, 3) in [0, 1] at points.

        Args:
            features: (N, F) features of the points, from `density`.
            directions: (N, 3) unit viewing directions.
            camera_indices: (N,) training image of each point, for fields with an appearance per image; None for the
                appearance in evaluation.
        """


@runtime_checkable
class HasAlpha(Protocol):
    """A field of surfaces, which computes the opacity of intervals: NeuS (Wang et al. 2021), equation 13."""

    def alpha(self, points: Points, directions: Tensor, deltas: Tensor) -> tuple[Tensor, Tensor]:
        """Return the opacity of intervals around points.

        Args:
            points: N points, in the middle of their intervals.
            directions: (N, 3) unit directions of their rays.
            deltas: (N,) lengths of the intervals, scene units.

        Returns:
            opacity (N,) in [0, 1], and features (N, F) for `color`.
        """


@runtime_checkable
class HasGridDensity(Protocol):
    """A field that one compiled call traces if its density is a small network on a hash grid."""

    def grid_density(self) -> GridDensity | None:
        """Return the density as `kernels.traced.trace` computes it; None to evaluate `Field.density` instead."""


@runtime_checkable
class HasGridColor(HasGridDensity, Protocol):
    """A field that one compiled call traces and trains if density and colour are small networks on a hash grid."""

    def grid_color(self) -> GridColor | None:
        """Return the colour for `nerfloom.kernels.traced.colors`; None to evaluate `Field.color` instead."""


@runtime_checkable
class HasSignedDistance(Protocol):
    """A field that is defined by the distance to the nearest surface."""

    def signed_distance(self, points: Points) -> Tensor:
        """Return the distances (N,) from `points` to the nearest surface, scene units, negative inside."""


class MLP(nn.Sequential):
    """A fully connected network: linear layers with ReLU between them.

    With up to 8 layers of up to 384 features, it is one compiled kernel on the CPU.

    Args:
        widths: number of features of the input, of each hidden layer, and of the output.
        bias: whether the layers have biases.
        activation: activation function of the output.

    Raises:
        ConfigError: if a width is less than 1, or the weights need more memory than the machine has.
    """

    def __init__(self, *widths: int, bias: bool = True, activation: Activation = "none") -> None:
        if min(widths) < 1:
            raise ConfigError(f"each layer of a network needs 1 feature or more, not {shown(min(widths))}")
        require(4.0 * sum(inputs * outputs for inputs, outputs in pairwise(widths)), "a network")
        layers: list[nn.Module] = []
        for index, (inputs, outputs) in enumerate(pairwise(widths)):
            if index:
                layers.append(nn.ReLU(inplace=True))
            layers.append(nn.Linear(inputs, outputs, bias=bias))
        super().__init__(*layers)
        if not bias:  # He et al. 2015: with torch's default weights, which are smaller, training starts slowly
            for layer in layers:
                if isinstance(layer, nn.Linear):
                    nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu")
        self.bias = bias
        self.activation = activation

    def forward(self, *inputs: Tensor) -> Tensor:
        """Return the output (N, D_out) for `inputs`, parts (N, D_i) that are concatenated along their features."""
        weights, biases = self.parameters_by_layer()
        return mlp(inputs, weights, self.activation, biases)

    def density(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Return the density (N,), and the output (N, D_out); its first feature is the log-density.

        The network must have no activation function at its output.

        Args:
            inputs: parts (N, D_i) that are concatenated along their features.
        """
        return density_mlp(inputs, *self.parameters_by_layer())

    def first(self, *inputs: Tensor) -> Tensor:
        """Return the first output (N,) alone, without the activation function of the output.

        Args:
            inputs: parts (N, D_i) that are concatenated along their features.
        """
        weights, biases = self.parameters_by_layer()
        last = None if biases is None else [*biases[:-1], biases[-1][:1]]
        return mlp(inputs, [*weights[:-1], weights[-1][:1]], "none", last)[:, 0]

    def parameters_by_layer(self) -> tuple[list[Tensor], list[Tensor] | None]:
        """Return the weights of each layer, and the biases if there are any."""
        layers = [layer for layer in self if isinstance(layer, nn.Linear)]
        return [layer.weight for layer in layers], [layer.bias for layer in layers] if self.bias else None
