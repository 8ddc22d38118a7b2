"""DenseGrid: features on dense grids of several resolutions, and two small networks that read them.

Say here what your method does and where it was published; the first line is what `ns-train --help` shows.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from nerfloom import Field, Method, Points, Scene
from nerfloom.encodings.hash_grid import HashGrid
from nerfloom.fields.base import MLP
from nerfloom.geometry.bounds import to_unit_box
from nerfloom.kernels.encodings.contraction import contract_to_unit
from nerfloom.kernels.encodings.spherical_harmonics import spherical_harmonics
from nerfloom.kernels.math import truncated_exp
from nerfloom.samplers import choice

DIRECTION_LEVELS = 4
"""Bands of spherical harmonics of the direction."""


@dataclass(frozen=True)
class DenseGridConfig(
    choice.SamplingConfig,
    max_num_iterations=20_000,
    samples_per_batch=2**15,
    learning_rate=1e-2,
    adam_beta2=0.95,
    adam_eps=1e-15,
):
    """Settings of dense-grid. Each field is a flag, and the string under it is its help; above are changed defaults."""

    num_levels: int = 8
    """Grids, each finer than the one before."""
    features_per_level: int = 2
    """Features stored at a grid's vertex: 1, 2, 4 or 8."""
    base_resolution: int = 16
    """Cells along an axis of the coarsest grid."""
    max_resolution: int = 128
    """Cells along an axis of the finest grid."""
    hidden_width: int = 64
    """Features of a layer of the two networks."""
    num_features: int = 15
    """Features that the first network passes to the second, in addition to density."""


class DenseGridField(Field):
    """Density at any position, and colour along a direction.

    Args:
        config: sizes of the grids and of the networks.
        box: (2, 3) corners of the part of space that matters.
        contracted: the grids hold all of space, contracted around the box, rather than the box alone.
    """

    box: Tensor
    runs_on_kernels = True  # nearly all of its work is in compiled kernels, none in torch's own operations

    def __init__(self, config: DenseGridConfig, box: Tensor, contracted: bool) -> None:
        super().__init__()
        self.contracted = contracted
        self.register_buffer("box", box.clone())  # a buffer: it follows the model to its device and into checkpoints
        self.grids = HashGrid(
            config.num_levels,
            config.features_per_level,
            config.base_resolution,
            config.max_resolution,
            log2_table_size=((config.max_resolution + 1) ** 3).bit_length(),  # room for every vertex: none is hashed
            sparse=True,
        )
        width, num_features = config.hidden_width, config.num_features
        self.density_head = MLP(self.grids.num_features, width, 1 + num_features, bias=False)
        self.color_head = MLP(num_features + DIRECTION_LEVELS**2, width, 3, bias=False, activation="sigmoid")

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        unit = (contract_to_unit if self.contracted else to_unit_box)(points.positions, self.box)
        values = self.density_head(self.grids(unit))
        return truncated_exp(values[:, 0]), values[:, 1:]

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        return self.color_head(features, spherical_harmonics(directions, DIRECTION_LEVELS)).float()


def make_field(config: DenseGridConfig, scene: Scene) -> DenseGridField:
    """Return the field for a scene."""
    return DenseGridField(config, scene.box, contracted=choice.contracted_box(config, scene) is not None)


METHOD = Method(
    DenseGridConfig(),
    paper="none",
    field=make_field,
    sampler=choice.make_sampler,  # an occupancy grid for a scene in a box, else proposals
    decide=choice.decide_sampler,
    interface=3,
)
