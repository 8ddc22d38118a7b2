"""NeRF++: two fields for captures without bounds, one inside of a sphere around the cameras and one outside of it.

Zhang et al., "NeRF++: Analyzing and Improving Neural Radiance Fields", arXiv 2020. `--encoding frequency` has the
paper's networks, NeRF's inside and one of the same shape on the inverted sphere outside, each coarse and fine: for a
GPU. `--encoding hash-grid` puts the same two fields on hash grids (Mueller et al. 2022), with an occupancy grid inside:
for a processor. Other methods take the background alone (`--background-model sphere`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import ClassVar, Literal

from framework import Decision, Field, Method, Sampler, Scene
from framework.base.config import AT_LEAST_0, Range
from framework.base.decisions import Choice, fill
from framework.base.optimised import Optimised
from framework.encodings.hash_grid import HashGrid
from framework.fields.encoded import EncodedField
from framework.fields.inverted import InvertedField
from framework.kernels.hash_grid_layout import MAX_LEVELS, MAX_LOG2_TABLE_SIZE, MAX_RESOLUTION
from framework.rendering.background import background_renderer
from framework.samplers.background import decide_background, foreground
from framework.samplers.choice import contracted_box
from framework.samplers.inside import make_foreground_sampler
from framework.scene.few_images import decide_few_images
from methods import vanilla_nerf
from methods.vanilla_nerf import A_RAY, OCCUPANCY_SAMPLES_PER_BATCH, OPEN_UNTIL, VanillaNeRFConfig

GRID_SAMPLES_PER_BATCH = 2**16
"""Samples of a training step on hash grids, instant-ngp's."""


@dataclass(frozen=True)
class NeRFPlusPlusConfig(VanillaNeRFConfig, num_rays_per_batch=1_024):
    """Settings of nerf-plus-plus; those of the networks are vanilla-nerf's, which are the paper's too."""

    RANGES: ClassVar[dict[str, Range]] = {
        "grid_learning_rate": AT_LEAST_0,
        "num_levels": (1, MAX_LEVELS),
        "features_per_level": (1, 64),
        "base_resolution": (1, MAX_RESOLUTION),
        "max_resolution": (1, MAX_RESOLUTION),
        "log2_table_size": (1, MAX_LOG2_TABLE_SIZE),
        "grid_width": (1, 2**14),
    }
    """Allowed range of each numeric setting."""
    encoding: Literal["frequency", "hash-grid"] = "frequency"
    """frequency: the paper's networks. hash-grid: hash grids with small networks, which learn in minutes on a CPU."""
    grid_learning_rate: float = 1e-2
    """Initial learning rate of the hash grids and of the networks that read them (hash-grid)."""
    num_levels: int = 16
    """Number of levels of each hash grid (hash-grid)."""
    features_per_level: int = 2
    """Features per grid vertex (hash-grid)."""
    base_resolution: int = 16
    """Cells per axis at the coarsest level (hash-grid)."""
    max_resolution: int = 2_048
    """Cells per axis at the finest level (hash-grid)."""
    log2_table_size: int = 18
    """Maximum number of table entries per level, log2 (hash-grid)."""
    grid_width: int = 64
    """Features per hidden layer of the networks that read the grids (hash-grid)."""
    sparse_updates: bool = True
    """Whether Adam updates only the table entries that a step used (hash-grid)."""


def decide(config: NeRFPlusPlusConfig, scene: Scene) -> tuple[NeRFPlusPlusConfig, list[Decision]]:
    """Fill in the settings that depend on the scene: a sphere, if there may be something outside of its box.

    Args:
        config: the method's settings; those left open are filled in.
        scene: properties of the data.

    Returns:
        Settings without open ones, and a record of each that was filled in.
    """
    grids = config.encoding == "hash-grid"
    config, made = decide_background(config, scene, "sphere", bounded="occupancy" if grids else None)
    config, few = decide_few_images(config, scene, OPEN_UNTIL)
    made += few
    if config.sampler != "occupancy":
        return config, made
    samples = GRID_SAMPLES_PER_BATCH if grids else OCCUPANCY_SAMPLES_PER_BATCH
    config, more = fill(config, Choice("samples_per_batch", samples, A_RAY, "samples a step"))
    return config, made + more


def make_field(config: NeRFPlusPlusConfig, scene: Scene) -> Field:
    """Return the field inside of the sphere, or of all of the scene if there is no sphere.

    Args:
        config: the method's settings, none left open.
        scene: properties of the data.
    """
    if config.encoding == "frequency":
        return vanilla_nerf.make_field(config, scene)
    scene = foreground(config, scene)
    unbounded = contracted_box(config, scene) is not None
    return _on_grids(config, EncodedField(scene.box, _grid(config), config.grid_width, unbounded=unbounded))


def make_background(config: NeRFPlusPlusConfig, scene: Scene) -> Field:
    """Return the field outside of the sphere, at points of the inverted sphere.

    Args:
        config: the method's settings, none left open.
        scene: properties of the data.
    """
    if config.encoding == "frequency":
        return vanilla_nerf.make_background(config, scene)
    return _on_grids(config, InvertedField(_grid(config), config.grid_width))


def _grid(config: NeRFPlusPlusConfig) -> HashGrid:
    return HashGrid(
        config.num_levels,
        config.features_per_level,
        config.base_resolution,
        config.max_resolution,
        config.log2_table_size,
        config.sparse_updates,
        opening=config.open_levels_until > 0,
    )


def _on_grids(config: NeRFPlusPlusConfig, field: Field) -> Field:
    """Return a `field` with the optimiser's settings of hash grids."""
    rate = config.grid_learning_rate
    field.optimised = Optimised("grids", rate, betas=(0.9, 0.99), eps=1e-15, schedule="hold-exponential")
    return field


def sampler(config: NeRFPlusPlusConfig, scene: Scene) -> Sampler:
    """Return the sampler of the inside; the coarse field of hierarchical sampling is built like the fine one.

    Args:
        config: the method's settings, none left open.
        scene: properties of the data.
    """
    return make_foreground_sampler(config, scene, partial(make_field, config, scene))


METHOD = Method(
    NeRFPlusPlusConfig(),
    paper="arXiv:2010.07492",
    field=make_field,
    sampler=sampler,
    renderer=partial(background_renderer, make_field=make_background),
    decide=decide,
)
