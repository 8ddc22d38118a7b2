"""An encoding that holds features in space, and two small networks: Instant-NGP (Mueller et al. 2022), section 5.4."""

from __future__ import annotations

import torch
from torch import Tensor

from framework.encodings import FeaturePlanes, HashGrid
from framework.fields.base import MLP, Field
from framework.kernels.math import split_density, truncated_exp
from framework.kernels.spherical_harmonics import spherical_harmonics


class BoxField(Field):
    """A field whose features stand in a box.

    Args:
        box: (2, 3) the part of space that is encoded.
        encoding: of positions in [0, 1]^3, or of those and time.
    """

    box: Tensor
    scale: Tensor
    shift: Tensor

    def __init__(self, box: Tensor, encoding: HashGrid | FeaturePlanes) -> None:
        super().__init__()
        self.register_buffer("box", box.clone())
        size = box[1] - box[0]
        self.register_buffer("scale", 1 / size, persistent=False)
        self.register_buffer("shift", -box[0] / size, persistent=False)
        self.encoding = encoding

    def encode(self, positions: Tensor, times: Tensor | None, known: Tensor | None = None) -> Tensor:
        """Features (N, E) at positions (N, 3), which may be `known` already.

        Raises: ValueError where the encoding wants times and there are none.
        """
        unit = torch.addcmul(self.shift, positions, self.scale)
        if self.encoding.dims == 4:
            if times is None:
                raise ValueError("this field changes with time: it needs the times of its positions")
            unit = torch.cat([unit, times[:, None].to(unit)], dim=-1)
        return self.encoding(unit, known=known)


class EncodedField(BoxField):
    """Density from the encoding's features, colour from 16 features and the view's spherical harmonics.

    Args:
        box: (2, 3) the part of space that is encoded.
        encoding: of positions in [0, 1]^3, or of those and time.
        width: features of a hidden layer (64 in the paper).
        num_features: features handed from density to colour (16 in the paper, the first being log-density).
        direction_levels: bands of spherical harmonics (4 in the paper); 0 for colours that look alike from all sides.
    """

    def __init__(
        self,
        box: Tensor,
        encoding: HashGrid | FeaturePlanes,
        width: int = 64,
        num_features: int = 16,
        direction_levels: int = 4,
    ) -> None:
        super().__init__(box, encoding)
        self.direction_levels = direction_levels
        self.density_head = MLP(encoding.num_features, width, num_features, bias=False)
        self.color_head = MLP(num_features + direction_levels**2, width, width, 3, bias=False, activation="sigmoid")

    def density(self, positions: Tensor, times: Tensor | None = None) -> tuple[Tensor, Tensor]:
        return split_density(self.density_head(self.encode(positions, times)))

    @torch.no_grad()
    def trace(self, positions: Tensor, times: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
        encoded = self.encode(positions, times)
        features = self.density_head(encoded)
        return truncated_exp(features[:, 0]), features, encoded

    def retrace(
        self, positions: Tensor, times: Tensor | None, features: Tensor, memory: Tensor
    ) -> tuple[Tensor, Tensor]:
        return split_density(self.density_head(self.encode(positions, times, known=memory), known=features))

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        if self.direction_levels == 0:
            return self.color_head(features).float()
        view = spherical_harmonics(directions, self.direction_levels)
        return self.color_head(features, view.to(features.dtype)).float()
