"""Fields evaluated at several points of each conical frustum: Zip-NeRF (Barron et al. 2023), section 3."""

from __future__ import annotations

import torch
from torch import Tensor

from nerfloom.encodings.multisampled import MultisampledHashGrid
from nerfloom.fields.encoded import BoxField, DensityField, EncodedField
from nerfloom.geometry.multisamples import fixed_pattern, hashed_pattern
from nerfloom.geometry.points import Points
from nerfloom.kernels.grids.multisamples import unit_multisamples


class MultisampledDensity(DensityField):
    """A `DensityField` of conical frustums, for proposals; its encoding is a `MultisampledHashGrid`."""

    footprint = "frustum"

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        features = encode_frustums(self, points)
        return self.head.density(features)[0], features


class MultisampledField(EncodedField):
    """An `EncodedField` of conical frustums; its encoding is a `MultisampledHashGrid`."""

    footprint = "frustum"

    def encoded(self, points: Points) -> Tensor:
        return encode_frustums(self, points)


def encode_frustums(field: BoxField, points: Points) -> Tensor:
    """Return the features (N, E) of the frustums of points; points without a frustum count as having no size.

    The pattern of a frustum's points is turned by a hash of its ends in training mode, and fixed otherwise.

    Args:
        field: a field on a `MultisampledHashGrid`.
        points: N points.
    """
    assert isinstance(field.encoding, MultisampledHashGrid)
    cones = points.frustums
    if cones is None:
        unit = field.unit(points.positions)
        return field.encoding(torch.cat([unit, torch.zeros_like(unit[:, :1])], dim=-1)[:, None])
    pattern = hashed_pattern(cones) if field.training else fixed_pattern(cones)
    return field.encoding(unit_multisamples(cones, pattern, field.box, field.unbounded))
