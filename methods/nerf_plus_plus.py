"""NeRF++: two fields for unbounded captures, one inside a sphere around the cameras and one outside.

Zhang et al., "NeRF++: Analyzing and Improving Neural Radiance Fields", arXiv 2020. `--encoding frequency` has the
paper's networks, for a GPU: NeRF's network inside, and one of the same shape on the inverted sphere outside, each
coarse and fine. `--encoding hash-grid` uses hash grids (Mueller et al. 2022) for both fields, with an occupancy grid
inside, for a CPU. Other methods can use the background alone (`--background-model sphere`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Literal

from nerfloom import Decision, Field, Method, Sampler, Scene
from nerfloom.encodings.hash_grid import HashGrid
from nerfloom.fields.encoded import EncodedField
from nerfloom.fields.inverted import InvertedField
from nerfloom.losses.few_images import decide_few_images
from nerfloom.methods import vanilla_nerf
from nerfloom.methods._grids import GRID_WIDTH, GridsConfig, grid_optimiser
from nerfloom.methods.vanilla_nerf import OCCUPANCY_SAMPLES_PER_BATCH, OPEN_UNTIL, VanillaNeRFConfig
from nerfloom.rendering.background import background_renderer
from nerfloom.samplers.background import decide_background, foreground
from nerfloom.samplers.choice import contracted_box, decide_samples
from nerfloom.samplers.inside import make_foreground_sampler

GRID_SAMPLES_PER_BATCH = 2**16
"""Samples per training step on hash grids, as in instant-ngp."""


@dataclass(frozen=True)
class NeRFPlusPlusConfig(GridsConfig, VanillaNeRFConfig, num_rays_per_batch=1_024):
    """Settings of nerf-plus-plus; the network settings are vanilla-nerf's, as in the paper."""

    encoding: Literal["frequency", "hash-grid"] = "frequency"
    """frequency: the paper's networks. hash-grid: hash grids with small networks, which train in minutes on a CPU."""


def decide(config: NeRFPlusPlusConfig, scene: Scene) -> tuple[NeRFPlusPlusConfig, list[Decision]]:
    """Fill in the settings that depend on the scene, with a sphere if there may be something outside its box."""
    grids = config.encoding == "hash-grid"
    config, made = decide_background(config, scene, "sphere", bounded="occupancy" if grids else None)
    config, few = decide_few_images(config, scene, OPEN_UNTIL)
    config, samples = decide_samples(config, GRID_SAMPLES_PER_BATCH if grids else OCCUPANCY_SAMPLES_PER_BATCH)
    return config, made + few + samples


def make_field(config: NeRFPlusPlusConfig, scene: Scene) -> Field:
    """Return the field inside the sphere, or of the whole scene if there is no sphere."""
    if config.encoding == "frequency":
        return vanilla_nerf.make_field(config, scene)
    scene = foreground(config, scene)
    unbounded = contracted_box(config, scene) is not None
    field = EncodedField(scene.box, _grid(config), GRID_WIDTH, unbounded=unbounded)
    field.optimised = grid_optimiser(config)
    return field


def make_background(config: NeRFPlusPlusConfig, scene: Scene) -> Field:
    """Return the field outside the sphere, at points of the inverted sphere."""
    if config.encoding == "frequency":
        return vanilla_nerf.make_background(config, scene)
    field = InvertedField(_grid(config), GRID_WIDTH)
    field.optimised = grid_optimiser(config)
    return field


def _grid(config: NeRFPlusPlusConfig) -> HashGrid:
    return HashGrid.of(config, config.open_levels_until)


def sampler(config: NeRFPlusPlusConfig, scene: Scene) -> Sampler:
    """Return the sampler of the inside; the coarse field of hierarchical sampling is built like the fine one."""
    return make_foreground_sampler(config, scene, partial(make_field, config, scene))


METHOD = Method(
    NeRFPlusPlusConfig(),
    paper="arXiv:2010.07492",
    field=make_field,
    sampler=sampler,
    renderer=partial(background_renderer, make_field=make_background),
    model=vanilla_nerf.VanillaNeRF,
    decide=decide,
)
