"""A field on the inverted sphere: the scene outside a sphere (NeRF++, Zhang et al. 2020)."""

from __future__ import annotations

import torch
from torch import Tensor

from nerfloom.encodings.hash_grid import HashGrid
from nerfloom.fields.encoded import EncodedField


class InvertedField(EncodedField):
    """A field of points (N, 4) of the inverted sphere: a direction of length 1, and 1/r.

    The grid needs no fourth axis, because the points form a three-dimensional shell. They are mapped as by contraction
    (mip-NeRF 360, Barron et al. 2022, equation 10), to (2 - 1/r) times the direction, between the spheres of radius 1
    and 2, which leaves resolution for distant parts.

    Args:
        encoding: encoding of positions in [0, 1]^3.
        width: features of a hidden layer.
        direction_levels: bands of the spherical harmonics of the viewing direction; 0 for none.
    """

    def __init__(self, encoding: HashGrid, width: int = 64, direction_levels: int = 4) -> None:
        box = torch.tensor([[-2.0] * 3, [2.0] * 3])
        super().__init__(box, encoding, width, direction_levels=direction_levels)

    def unit(self, positions: Tensor) -> Tensor:
        """Map points of the inverted sphere (N, 4) to the [0, 1]^3 of the encoding."""
        direction, inverse = positions[:, :3], positions[:, 3:]
        return (0.5 - 0.25 * inverse) * direction + 0.5
