"""Fields on hash grids that account for the size of points: levels finer than a point get less weight."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from nerfloom.encodings.multisampled import MultisampledHashGrid
from nerfloom.fields.encoded import BoxField, DensityField, EncodedField
from nerfloom.geometry.points import Footprint, Points
from nerfloom.kernels.grids.multisamples import ball_deviations, frustum_balls, unit_balls


class SizedGrid(BoxField):
    """A field on a hash grid that weights features by the size of points.

    Zip-NeRF (Barron et al. 2023), section 3.1. Unlike there, a frustum is looked up at its mean only, and its size is
    the size of a ball with the same volume. This is a mixin, constructed like the field class beside it; the encoding
    is a `MultisampledHashGrid`.
    """

    footprint: ClassVar[Footprint] = "frustum"

    def encoded(self, points: Points) -> Tensor:
        return self.encoding(self.balls(points)[:, None])

    def balls(self, points: Points) -> Tensor:
        """Return positions and standard deviations (N, 4) in units of the encoding.

        Args:
            points: N points with frustums, or with Gaussians (exports); other points get half a cell of the finest
                level. The encoding has no time axis.
        """
        if points.frustums is not None:
            return frustum_balls(points.frustums, self.box, self.unbounded)
        if points.variances is not None:
            deviations = ball_deviations(*points.variances.unbind(-1))
            return unit_balls(points.positions, deviations, self.box, self.unbounded)
        assert isinstance(self.encoding, MultisampledHashGrid)
        unit = self.unit(points.positions)
        size = 0.5 / self.encoding.layout.resolutions[-1]
        return torch.cat([unit, torch.full_like(unit[:, :1], size)], dim=-1)


class SizedDensity(SizedGrid, DensityField):
    """A field of density without colour, for proposals, on a hash grid that accounts for the size of points."""


class SizedField(SizedGrid, EncodedField):
    """A field of density and colour on a hash grid that accounts for the size of points."""
