"""What every field offers, and the small network most are made of."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from itertools import pairwise

import torch
from torch import Tensor, nn

from framework.kernels.mlp import Activation, mlp

DensityFunction = Callable[[Tensor, Tensor | None], tuple[Tensor, Tensor]]
"""(positions (N, 3), times (N,) or None) -> density (N,), features (N, F). What samplers are given."""


class Field(nn.Module, ABC):
    """Density and colour at a point. Two functions, so that a sampler can ask for density alone."""

    @abstractmethod
    def density(self, positions: Tensor, times: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Density at positions.

        Args:
            positions: (N, 3) scene coordinates; N may be 0.
            times: (N,) in [0, 1], or None for a scene that stands still.
        Returns: sigma (N,) float32, at least 0, 1/length; features (N, F) for `color`.
        """

    @abstractmethod
    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        """Colour (N, 3) in [0, 1] of `features` (N, F) seen along unit `directions` (N, 3).

        `camera_indices` (N,) tells a field with per-image appearance which image is meant; None asks for the
        appearance used in evaluation.
        """


class MLP(nn.Sequential):
    """Linear layers with ReLU between them.

    Args:
        widths: features of the input, of each hidden layer, and of the output.
        bias: whether the layers have one. Without, and at most 128 wide, the network runs as one compiled kernel.
        activation: of the output.
    """

    def __init__(self, *widths: int, bias: bool = True, activation: Activation = "none") -> None:
        layers: list[nn.Module] = []
        for index, (inputs, outputs) in enumerate(pairwise(widths)):
            if index:
                layers.append(nn.ReLU(inplace=True))
            layers.append(nn.Linear(inputs, outputs, bias=bias))
        super().__init__(*layers)
        self.bias = bias
        self.activation = activation

    def forward(self, *inputs: Tensor) -> Tensor:
        """(N, D_i) parts, which stand side by side, to (N, outputs)."""
        if not self.bias:
            return mlp(inputs, [layer.weight for layer in self if isinstance(layer, nn.Linear)], self.activation)
        out = super().forward(inputs[0] if len(inputs) == 1 else torch.cat(inputs, dim=-1))
        if self.activation == "relu":
            return torch.relu(out)
        return torch.sigmoid(out) if self.activation == "sigmoid" else out
