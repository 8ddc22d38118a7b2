"""Instant-NGP: a multiresolution hash grid, two small networks and an occupancy grid.

Mueller et al., "Instant Neural Graphics Primitives with a Multiresolution Hash Encoding", SIGGRAPH 2022.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from framework import Decision, Method, Scene
from framework.base.config import AUTO, Auto, Range
from framework.base.decisions import Choice, fill
from framework.encodings.hash_grid import HashGrid
from framework.fields.encoded import EncodedField
from framework.kernels.hash_grid import MAX_LEVELS, MAX_LOG2_TABLE_SIZE, MAX_RESOLUTION
from framework.samplers.choice import SamplingConfig, contracted_box, make_sampler, sampler_choice

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
class InstantNGPConfig(
    SamplingConfig,
    max_num_iterations=20_000,
    num_rays_per_batch=8_192,
    rays_per_pixel=4,
    train_rays_per_pixel_from=0.75,
    learning_rate=1e-2,
    lr_schedule="hold-exponential",
    lr_final=0.05,
    adam_beta2=0.95,
    adam_eps=1e-15,
    num_steps=AUTO,
):
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
    num_levels: int = 16
    """Resolutions of the hash grid."""
    features_per_level: int = 2
    """Features stored at a grid vertex."""
    base_resolution: int = 16
    """Cells along an axis at the coarsest level."""
    max_resolution: Auto[int] = AUTO
    """Cells along an axis at the finest level. If not given: a power of two, `detail` cells a pixel or more."""
    detail: Auto[int] = AUTO
    """Finest cells along the images' longer side for each of its pixels. If not given: what suits the time."""
    log2_table_size: Auto[int] = AUTO
    """Entries of a level's table at most, as a power of two. If not given: what suits the time."""
    sparse_updates: Auto[bool] = AUTO
    """Adam updates only the table entries that a step used. If not given: where there are 2^17 or more a level."""
    hidden_width: int = 64
    """Features of a layer of the two networks."""
    view_dependence: bool = True
    """Colours depend on where they are seen from. False saves a few per cent of the time, and most scenes need it."""


def decide(config: InstantNGPConfig, scene: Scene) -> tuple[InstantNGPConfig, list[Decision]]:
    """Return the settings with what suits the time and the scene, and why.

    Args:
        config: settings, some of which may be open.
        scene: facts about the data.
    """
    seconds = math.inf if config.max_seconds is None else config.max_seconds
    limit, log2_table_size, num_steps, samples, detail = next(plan for plan in PLANS if seconds <= plan[0])
    suits = "that suits the time" if limit < math.inf else "there is time for it"
    config, made = fill(
        config,
        sampler_choice(config, scene.unbounded),
        Choice("log2_table_size", log2_table_size, suits),
        Choice("num_steps", num_steps, suits, "steps along the box's diagonal"),
        Choice("samples_per_batch", samples, suits, "samples a step"),
    )
    config, _ = fill(config, Choice("detail", detail, suits))  # told with the resolution that follows from it
    finest = 2 ** (config.detail * scene.image_size - 1).bit_length()
    pays = config.log2_table_size >= SPARSE_FROM
    config, more = fill(
        config,
        Choice(
            "max_resolution",
            finest,
            f"each of the images' {scene.image_size} pixels gets {config.detail} or more",
            "finest cells along an axis",
        ),
        Choice("sparse_updates", pays, f"tables have 2^{config.log2_table_size} entries a level"),
    )
    return config, made + more


def make_field(config: InstantNGPConfig, scene: Scene) -> EncodedField:
    """Return one hash field.

    Args:
        config: the settings, decided.
        scene: facts about the data.
    """
    grid = HashGrid(
        config.num_levels,
        config.features_per_level,
        config.base_resolution,
        config.max_resolution,
        config.log2_table_size,
        config.sparse_updates,
    )
    return EncodedField(
        scene.box,
        grid,
        config.hidden_width,
        direction_levels=4 if config.view_dependence else 0,
        unbounded=contracted_box(config, scene) is not None,
    )


METHOD = Method(InstantNGPConfig(), paper="arXiv:2201.05989", field=make_field, sampler=make_sampler, decide=decide)
