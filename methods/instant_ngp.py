"""Instant-NGP: a multiresolution hash grid, two small networks and an occupancy grid.

Mueller et al., "Instant Neural Graphics Primitives with a Multiresolution Hash Encoding", SIGGRAPH 2022.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

from torch import Tensor

from framework import Decision, Method, Model, Rays, Rendered, Scene
from framework.base.config import Range, RaysPerPixel
from framework.encodings.hash_grid import HashGrid
from framework.fields.encoded import EncodedField
from framework.kernels.hash_grid import MAX_LEVELS, MAX_LOG2_TABLE_SIZE, MAX_RESOLUTION
from framework.rendering.volume import render_field
from framework.samplers.choice import SamplingConfig, contracted_box, make_sampler, sampler_decisions

PLANS = (
    (60.0, 16, 512, 2**15, 1),
    (150.0, 17, 512, 2**15, 2),
    (math.inf, 18, 1024, 2**16, 2),
)
"""What suits how much time: seconds of training at most, log2 of the table size, steps along the diagonal, samples a
step, finest cells a pixel. Small tables and batches learn fastest; large ones get further."""

SPARSE_FROM = 17
"""log2 of the table size from which sparse updates pay. On Lego after 45 s, with 2^16 entries, dense ones were 0.06,
0.23 and 0.25 dB better, as seldom used entries move further; after 300 s, with 2^18, sparse ones were 0.21 dB."""


@dataclass(frozen=True)
class InstantNGPConfig(SamplingConfig):
    """Settings of instant-ngp."""

    RANGES: ClassVar[dict[str, Range]] = {
        "num_levels": (1, MAX_LEVELS),
        "features_per_level": (1, 64),
        "base_resolution": (1, MAX_RESOLUTION),
        "max_resolution": (1, MAX_RESOLUTION),
        "log2_table_size": (1, MAX_LOG2_TABLE_SIZE),
        "detail": (1, 64),
        "hidden_width": (1, 2**14),
    }
    """What these numbers may be."""
    max_num_iterations: int = 20_000
    num_rays_per_batch: int = 8_192
    rays_per_pixel: RaysPerPixel = 4
    train_rays_per_pixel_from: float = 0.75
    samples_per_batch: int | None = None
    """Samples in a training step, the number of rays following. If not given: what suits the time (see `PLANS`)."""
    learning_rate: float = 1e-2
    lr_schedule: Literal["constant", "exponential", "cosine", "hold-exponential"] = "hold-exponential"
    lr_final: float = 0.05
    adam_beta2: float = 0.95
    adam_eps: float = 1e-15
    num_levels: int = 16
    """Resolutions of the hash grid."""
    features_per_level: int = 2
    """Features stored at a grid vertex."""
    base_resolution: int = 16
    """Cells along an axis at the coarsest level."""
    max_resolution: int | None = None
    """Cells along an axis at the finest level. If not given: a power of two, `detail` cells a pixel or more."""
    detail: int | None = None
    """Finest cells along the images' longer side for each of its pixels. If not given: what suits the time."""
    log2_table_size: int | None = None
    """Entries of a level's table at most, as a power of two. If not given: what suits the time."""
    sparse_updates: bool | None = None
    """Adam updates only the table entries that a step used. If not given: where there are 2^17 or more a level."""
    hidden_width: int = 64
    """Features of a layer of the two networks."""
    view_dependence: bool = True
    """Colours depend on where they are seen from. False saves a few per cent of the time, and most scenes need it."""
    num_steps: int | None = None
    """Steps along the box's diagonal. If not given: what suits the time."""

    def resolved(self) -> InstantNGPConfig:
        seconds = math.inf if self.max_seconds is None else self.max_seconds
        _, log2_table_size, num_steps, samples, detail = next(plan for plan in PLANS if seconds <= plan[0])
        log2_table_size = self.log2_table_size or log2_table_size
        sparse = log2_table_size >= SPARSE_FROM if self.sparse_updates is None else self.sparse_updates
        return replace(
            self,
            log2_table_size=log2_table_size,
            sparse_updates=sparse,
            num_steps=self.num_steps or num_steps,
            detail=self.detail or detail,
            samples_per_batch=self.samples_per_batch or samples,
        )


class InstantNGP(Model[InstantNGPConfig]):
    """One hash field, marched through an occupancy grid or sampled by proposals."""

    runs_on_kernels = True

    def __init__(self, config: InstantNGPConfig, scene: Scene) -> None:
        super().__init__(config, scene)
        assert config.log2_table_size is not None
        assert config.detail is not None
        finest = config.max_resolution or 2 ** (config.detail * scene.image_size - 1).bit_length()
        grid = HashGrid(
            config.num_levels,
            config.features_per_level,
            config.base_resolution,
            finest,
            config.log2_table_size,
            bool(config.sparse_updates),
        )
        self.field = EncodedField(
            scene.box,
            grid,
            config.hidden_width,
            direction_levels=4 if config.view_dependence else 0,
            unbounded=contracted_box(config, scene) is not None,
        )
        self.sampler = make_sampler(config, scene)

    def decisions(self) -> list[Decision]:
        found = sampler_decisions(self.config, self.scene)
        if self.config.max_resolution is not None:
            return found
        size, detail = self.scene.image_size, self.config.detail
        reason = f"each of the images' {size} pixels gets {detail} or more"
        finest = self.field.encoding.layout.resolutions[-1]
        return [*found, Decision("finest cells along an axis", f"{finest}", reason)]

    def render(self, rays: Rays, background: Tensor) -> Rendered:
        return render_field(self.field, self.sampler, rays, background, self.training)

    def before_step(self, step: int, progress: float) -> None:
        self.sampler.update(step, self.field.density)


METHOD = Method(InstantNGP, InstantNGPConfig(), paper="arXiv:2201.05989")
