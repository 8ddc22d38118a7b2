"""Fields on hash grids that know the size of points: levels finer than a point count less."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from framework.encodings.hash_grid import HashGrid
from framework.fields.encoded import BoxField, DensityField, EncodedField
from framework.geometry.bounds import contraction_scale
from framework.geometry.points import Footprint, Points
from framework.kernels.downweighting import level_weights


class SizedGrid(BoxField):
    """A field on a hash grid whose features are weighted by the size of points.

    Zip-NeRF (Barron et al. 2023), section 3.1. Unlike there, a Gaussian is asked about at its mean alone, and its size
    is that of the ball with the same volume. It is made like the class of fields that it is mixed with.
    """

    footprint: ClassVar[Footprint] = "gaussian"

    def encode_points(self, points: Points) -> Tensor:
        """Return the weighted features (N, E) of the encoding.

        Args:
            points: N points, with or without their size.
        """
        grid = self.encoding
        assert isinstance(grid, HashGrid)
        features = self.encode(points.positions, points.times)
        weights = level_weights(self.deviations(points), grid.resolutions)
        return features * weights.repeat_interleave(grid.table.shape[1], dim=-1).to(features.dtype)

    @torch.no_grad()
    def deviations(self, points: Points) -> Tensor:
        """Return the standard deviations (N,) in units of the encoding, without a gradient.

        Args:
            points: N points; those without a size, as exports ask about, get that of half a cell of the finest level.
        """
        if points.variances is None:
            assert isinstance(self.encoding, HashGrid)
            return points.positions.new_full((len(points),), 0.5 / self.encoding.layout.resolutions[-1])
        along, across = points.variances.log().unbind(-1)  # their product would be too small for float32
        deviations = torch.exp((along + 2 * across) / 6) * self.scale.prod() ** (1 / 3)
        if not self.unbounded:
            return deviations
        middle, half = (self.box[0] + self.box[1]) / 2, (self.box[1] - self.box[0]) / 2
        return deviations / 2 * contraction_scale((points.positions - middle) / half)  # the box is half as wide there


class SizedDensity(SizedGrid, DensityField):
    """A field of density without colour, for proposals, on a hash grid that knows the size of points."""

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        features = self.encode_points(points)
        return self.head.density(features)[0], features


class SizedField(SizedGrid, EncodedField):
    """A field of density and colour on a hash grid that knows the size of points."""

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        return self.density_head.density(self.encode_points(points))
