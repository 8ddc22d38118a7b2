"""The field of Instant-NGP (Mueller et al. 2022), section 5.4: a hash grid and two small networks."""

from __future__ import annotations

import torch
from torch import Tensor

from framework.encodings import HashGrid
from framework.fields.base import MLP, Field
from framework.kernels.math import split_density, truncated_exp
from framework.kernels.spherical_harmonics import spherical_harmonics


class HashField(Field):
    """Density from hash features, colour from 16 features and the view's spherical harmonics.

    Args:
        box: (2, 3) the part of space that is encoded.
        grid: the encoding.
        width: features of a hidden layer (64 in the paper).
        num_features: features handed from density to colour (16 in the paper, the first being log-density).
        direction_levels: bands of spherical harmonics (4 in the paper); 0 for colours that look alike from all sides.
    """

    box: Tensor
    scale: Tensor
    shift: Tensor

    def __init__(
        self, box: Tensor, grid: HashGrid, width: int = 64, num_features: int = 16, direction_levels: int = 4
    ) -> None:
        super().__init__()
        self.register_buffer("box", box.clone())
        size = box[1] - box[0]
        self.register_buffer("scale", 1 / size, persistent=False)
        self.register_buffer("shift", -box[0] / size, persistent=False)
        self.grid = grid
        self.direction_levels = direction_levels
        self.density_head = MLP(grid.num_features, width, num_features, bias=False)
        self.color_head = MLP(num_features + direction_levels**2, width, width, 3, bias=False, activation="sigmoid")

    def density(self, positions: Tensor, times: Tensor | None = None) -> tuple[Tensor, Tensor]:
        return split_density(self.density_head(self.grid(self._unit(positions))))

    @torch.no_grad()
    def trace(self, positions: Tensor, times: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
        encoded = self.grid(self._unit(positions))
        features = self.density_head(encoded)
        return truncated_exp(features[:, 0]), features, encoded

    def retrace(
        self, positions: Tensor, times: Tensor | None, features: Tensor, memory: Tensor
    ) -> tuple[Tensor, Tensor]:
        return split_density(self.density_head(self.grid(self._unit(positions), known=memory), known=features))

    def _unit(self, positions: Tensor) -> Tensor:
        return torch.addcmul(self.shift, positions, self.scale)

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        if self.direction_levels == 0:
            return self.color_head(features).float()
        view = spherical_harmonics(directions, self.direction_levels)
        return self.color_head(features, view.to(features.dtype)).float()
