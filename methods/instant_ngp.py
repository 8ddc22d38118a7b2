"""Instant-NGP: a multiresolution hash grid, two small networks and an occupancy grid.

Mueller et al., "Instant Neural Graphics Primitives with a Multiresolution Hash Encoding", SIGGRAPH 2022.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from torch import Tensor

from framework import Method, Model, Rays, Rendered, Scene, TrainConfig
from framework.encodings import HashGrid
from framework.fields.hash import HashField
from framework.renderers import render_field
from framework.samplers.occupancy import OccupancySampler


@dataclass(frozen=True)
class InstantNGPConfig(TrainConfig):
    """Settings of instant-ngp."""

    max_num_iterations: int = 20_000
    num_rays_per_batch: int = 8_192
    samples_per_batch: int | None = 2**15
    learning_rate: float = 1e-2
    lr_schedule: Literal["constant", "exponential", "cosine", "hold-exponential"] = "hold-exponential"
    lr_final: float = 0.02
    adam_beta2: float = 0.99
    adam_eps: float = 1e-15
    num_levels: int = 16
    """Resolutions of the hash grid."""
    features_per_level: int = 2
    """Features stored at a grid vertex."""
    base_resolution: int = 16
    """Cells along an axis at the coarsest level."""
    max_resolution: int | None = None
    """Cells along an axis at the finest level. If not given: a power of two, at least twice the images' longer side."""
    log2_table_size: int = 17
    """Entries of a level's table at most, as a power of two."""
    sparse_updates: bool = True
    """Adam updates only the table entries that a step used."""
    hidden_width: int = 64
    """Features of a layer of the two networks."""
    grid_resolution: int = 128
    """Cells along an axis of the occupancy grid."""
    num_steps: int = 512
    """Steps along the box's diagonal."""
    early_stop: float = 1e-4
    """Transmittance below which the rest of a ray is dropped."""


class InstantNGP(Model[InstantNGPConfig]):
    """One hash field marched through an occupancy grid."""

    def __init__(self, config: InstantNGPConfig, scene: Scene) -> None:
        super().__init__(config, scene)
        finest = config.max_resolution or 2 ** (2 * scene.image_size - 1).bit_length()
        grid = HashGrid(
            config.num_levels,
            config.features_per_level,
            config.base_resolution,
            finest,
            config.log2_table_size,
            config.sparse_updates,
        )
        self.field = HashField(scene.box, grid, config.hidden_width)
        self.sampler = OccupancySampler(
            scene.box, config.grid_resolution, config.num_steps, config.early_stop, moving=scene.moving
        )

    def render(self, rays: Rays, background: Tensor) -> Rendered:
        return render_field(self.field, self.sampler, rays, background, self.training)

    def before_step(self, step: int) -> None:
        self.sampler.update(step, self.field.density)


METHOD = Method(InstantNGP, InstantNGPConfig(), paper="arXiv:2201.05989")
