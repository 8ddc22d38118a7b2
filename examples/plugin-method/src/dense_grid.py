"""DenseGrid: features on dense grids of several resolutions, and two small networks that read them.

Say here what your method does and where it was published; the first line is what `ns-train --help` shows.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from framework import Field, Method, Model, Rays, Rendered, Scene
from framework.encodings.hash_grid import HashGrid
from framework.fields.base import MLP
from framework.geometry.bounds import to_unit_box
from framework.kernels.contraction import contract_to_unit
from framework.kernels.math import truncated_exp
from framework.kernels.spherical_harmonics import spherical_harmonics
from framework.rendering.volume import render_field
from framework.samplers import choice

DIRECTION_LEVELS = 4
"""Bands of spherical harmonics of the direction."""


@dataclass(frozen=True)
class DenseGridConfig(choice.SamplingConfig):
    """Settings of dense-grid. Each field is a flag, and the string under it is its help."""

    max_num_iterations: int = 20_000
    samples_per_batch: int | None = 2**15
    learning_rate: float = 1e-2
    adam_beta2: float = 0.95
    adam_eps: float = 1e-15
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
    """Features that the first network hands to the second, beside density."""


class DenseGridField(Field):
    """What is anywhere in space: its density, and its colour as seen along a direction.

    Args:
        config: sizes of the grids and of the networks.
        box: (2, 3) corners of the part of space that matters.
        contracted: the grids hold all of space, contracted around the box, rather than the box alone.
    """

    box: Tensor

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

    def density(self, positions: Tensor, times: Tensor | None = None) -> tuple[Tensor, Tensor]:
        unit = (contract_to_unit if self.contracted else to_unit_box)(positions, self.box)
        values = self.density_head(self.grids(unit))
        return truncated_exp(values[:, 0]), values[:, 1:]

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        return self.color_head(features, spherical_harmonics(directions, DIRECTION_LEVELS)).float()


class DenseGridModel(Model[DenseGridConfig]):
    """A field, and a sampler that the scene chooses: an occupancy grid for one in a box, else proposals."""

    def __init__(self, config: DenseGridConfig, scene: Scene) -> None:
        super().__init__(config, scene)
        contracted = choice.contracted_box(config, scene) is not None
        self.field = DenseGridField(config, scene.box, contracted)
        self.sampler = choice.make_sampler(config, scene)

    def render(self, rays: Rays, background: Tensor) -> Rendered:
        return render_field(self.field, self.sampler, rays, background, jitter=self.training)

    def before_step(self, step: int, progress: float) -> None:
        self.sampler.update(step, self.field.density)


METHOD = Method(DenseGridModel, DenseGridConfig(), paper="none", interface=1)
