"""What every field offers, and the small network most are made of."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from itertools import pairwise
from typing import ClassVar, Protocol, runtime_checkable

from torch import Tensor, nn

from framework.base.errors import ConfigError, shown
from framework.base.optimised import Optimised
from framework.geometry.points import Footprint, Points
from framework.kernels.memory import require
from framework.kernels.mlp import Activation, mlp

DensityFunction = Callable[[Points], tuple[Tensor, Tensor]]
"""Points (N) to density (N,) and features (N, F): what samplers are given."""


class Field(nn.Module, ABC):
    """Density and colour at a point. Two functions, so that a sampler can ask for density alone."""

    footprint: ClassVar[Footprint] = "none"
    """What `density` wants to know of the points' size."""
    optimised: Optimised | None = None
    """How its parameters are optimised; as the model's if None."""
    runs_on_kernels: bool = False
    """Whether compiled kernels do its heavy work: then torch's own operations keep to one CPU thread."""

    @abstractmethod
    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        """Return density at points.

        Args:
            points: N points, with the `footprint` that the field asks for; N may be 0.
        Returns: sigma (N,) float32, at least 0, 1/length; features (N, F) for `color`.
        """

    @abstractmethod
    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        """Colour (N, 3) in [0, 1] of `features` (N, F) seen along unit `directions` (N, 3).

        `camera_indices` (N,) tells a field with per-image appearance which image is meant; None asks for the
        appearance used in evaluation.
        """


@runtime_checkable
class HasAlpha(Protocol):
    """A field of surfaces, which knows how opaque an interval is: NeuS (Wang et al. 2021), equation 13."""

    def alpha(self, points: Points, directions: Tensor, deltas: Tensor) -> tuple[Tensor, Tensor]:
        """Return the opacity of intervals around points, and features for `color`.

        Args:
            points: N points, in the middle of their intervals.
            directions: (N, 3) unit directions of their rays.
            deltas: (N,) lengths of the intervals, scene units.
        Returns: alpha (N,) in [0, 1], features (N, F).
        """


@runtime_checkable
class HasSignedDistance(Protocol):
    """A field that knows how far the nearest surface is."""

    def signed_distance(self, points: Points) -> Tensor:
        """Return distances (N,) to the nearest surface, scene units, negative inside.

        Args:
            points: N points.
        """


class MLP(nn.Sequential):
    """Linear layers with ReLU between them.

    Up to 384 features wide it runs as one compiled kernel.

    Args:
        widths: features of the input, of each hidden layer, and of the output.
        bias: whether the layers have one.
        activation: of the output.
    Raises: ConfigError where a width is less than 1, or the machine has less memory than the weights take.
    """

    def __init__(self, *widths: int, bias: bool = True, activation: Activation = "none") -> None:
        if min(widths) < 1:
            raise ConfigError(f"a network's layers have 1 feature or more, not {shown(min(widths))}")
        require(4.0 * sum(inputs * outputs for inputs, outputs in pairwise(widths)), "a network")
        layers: list[nn.Module] = []
        for index, (inputs, outputs) in enumerate(pairwise(widths)):
            if index:
                layers.append(nn.ReLU(inplace=True))
            layers.append(nn.Linear(inputs, outputs, bias=bias))
        super().__init__(*layers)
        if not bias:  # He et al. 2015: with torch's smaller default the small networks wake up slowly
            for layer in layers:
                if isinstance(layer, nn.Linear):
                    nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu")
        self.bias = bias
        self.activation = activation

    def forward(self, *inputs: Tensor) -> Tensor:
        """(N, D_i) parts, which stand side by side, to (N, outputs)."""
        layers = [layer for layer in self if isinstance(layer, nn.Linear)]
        biases = [layer.bias for layer in layers] if self.bias else None
        return mlp(inputs, [layer.weight for layer in layers], self.activation, biases)
