"""Density and appearance as sums of products of planes and lines, or of lines alone.

Chen et al., "TensoRF: Tensorial Radiance Fields", ECCV 2022.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import softplus

from nerfloom.encodings.planes import FeaturePlanes
from nerfloom.fields.base import MLP, Field
from nerfloom.geometry.bounds import to_unit_box
from nerfloom.geometry.points import Points
from nerfloom.kernels.encodings.contraction import contract_to_unit
from nerfloom.kernels.encodings.spherical_harmonics import spherical_harmonics
from nerfloom.kernels.networks.mlp import mlp

VM = (((0, 1), (2,)), ((0, 2), (1,)), ((1, 2), (0,)))
"""Three groups: a plane, and the line across it (equation 4)."""
CP = (((0,), (1,), (2,)),)
"""One group: a line along each axis (equation 3)."""
DENSITY_SHIFT, DENSITY_SCALE = -5.0, 25.0
"""Density is DENSITY_SCALE * softplus(sum of components + DENSITY_SHIFT), small at first (section 4.4). The authors'
code has -10. With that, thin structures do not appear within a minute: the gradient is as small as the density."""


class TensorField(Field):
    """A field with a sum of components as density (section 4.3).

    Colour has its own components; a linear basis and a small network turn them into RGB.

    Args:
        box: (2, 3) minimum and maximum corner of the encoded region, scene units.
        density, appearance: factors of the components.
        width: features per hidden layer of the colour network.
        num_features: outputs of the basis (27 in the paper).
        unbounded: whether the factors cover all of space, contracted around the box.
    """

    box: Tensor
    runs_on_kernels = True

    def __init__(
        self,
        box: Tensor,
        density: FeaturePlanes,
        appearance: FeaturePlanes,
        width: int,
        num_features: int = 27,
        unbounded: bool = False,
    ) -> None:
        super().__init__()
        self.unbounded = unbounded
        self.register_buffer("box", box.clone())
        self.density_factors, self.appearance_factors = density, appearance
        self.basis = torch.nn.Linear(appearance.num_features, num_features, bias=False)
        self.color_head = MLP(num_features + 16, width, width, 3, activation="sigmoid")

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        unit = self._unit(points.positions)
        components = self.density_factors(unit)
        inside = ((unit >= 0) & (unit <= 1)).all(-1)  # the box may have shrunk
        return softplus(components.float().sum(-1) + DENSITY_SHIFT) * DENSITY_SCALE * inside, unit

    def _unit(self, positions: Tensor) -> Tensor:
        return contract_to_unit(positions, self.box) if self.unbounded else to_unit_box(positions, self.box)

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        appearance = mlp([self.appearance_factors(features)], [self.basis.weight])
        return self.color_head(appearance, spherical_harmonics(directions)).float()
