"""Fields evaluated at several points of each conical frustum: Zip-NeRF (Barron et al. 2023), section 3."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from nerfloom.encodings.multisampled import MultisampledHashGrid
from nerfloom.fields.encoded import BoxField, DensityField, EncodedField
from nerfloom.geometry.multisamples import fixed_pattern, hashed_pattern
from nerfloom.geometry.points import Footprint, Points
from nerfloom.kernels.grids.multisamples import unit_multisamples


class MultisampledGrid(BoxField):
    """A field of conical frustums on a hash grid.

    The pattern of a frustum's points is turned by a hash of its ends in training mode, and fixed otherwise. Points
    without a frustum count as having no size. This is a mixin, constructed like the field class beside it; the encoding
    is a `MultisampledHashGrid`.
    """

    footprint: ClassVar[Footprint] = "frustum"

    def encoded(self, points: Points) -> Tensor:
        assert isinstance(self.encoding, MultisampledHashGrid)
        cones = points.frustums
        if cones is None:
            unit = self.unit(points.positions)
            return self.encoding(torch.cat([unit, torch.zeros_like(unit[:, :1])], dim=-1)[:, None])
        pattern = hashed_pattern(cones) if self.training else fixed_pattern(cones)
        return self.encoding(unit_multisamples(cones, pattern, self.box, self.unbounded))


class MultisampledDensity(MultisampledGrid, DensityField):
    """A field of density without colour, for proposals, at several points of each conical frustum."""


class MultisampledField(MultisampledGrid, EncodedField):
    """A field of density and colour at several points of each conical frustum."""
