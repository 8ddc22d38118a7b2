"""NeRF: large networks on frequency encodings, with coarse and fine sampling.

Mildenhall et al., "NeRF: Representing Scenes as Neural Radiance Fields for View Synthesis", ECCV 2020. With `--sampler
occupancy`, a single network with an occupancy grid skips empty and hidden space (as in NerfAcc, Li et al. 2023). With
`--background-model sphere` a second network shows the outside of a sphere, as in NeRF++ (Zhang et al. 2020).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

from torch import Tensor

from nerfloom import Decision, Method, RayModel, Sampler, Scene
from nerfloom.base.optimised import Optimised
from nerfloom.fields.nerf import NeRFField, NetworkConfig
from nerfloom.losses.few_images import FewImagesConfig, decide_few_images
from nerfloom.losses.terms import COLOR_ERROR, FEW_IMAGES, KNOWN_DISTANCES, CoarseColorError, SamplerLoss
from nerfloom.rendering.background import background_renderer
from nerfloom.samplers.background import BackgroundConfig, decide_background, foreground
from nerfloom.samplers.choice import HierarchicalConfig, contracted_box, decide_samples
from nerfloom.samplers.inside import make_foreground_sampler

OCCUPANCY_SAMPLES_PER_BATCH = 2**12
"""Samples per training step with the occupancy grid; the number of samples per ray varies a hundredfold."""
OCCUPANCY_RATE = 2.0
"""Factor of the learning rate with the occupancy grid. On Lego after 90 s on two cores, smaller batches and longer
marching steps (`num_steps`) at twice the rate reached 22.5 dB; 2^13 samples, 512 steps and the paper's rate reached 17
dB."""

OPEN_UNTIL = 0.5
"""Fraction of the budget for opening frequencies with few images, as in FreeNeRF's shorter Blender settings."""


@dataclass(frozen=True)
class VanillaNeRFConfig(
    HierarchicalConfig,
    BackgroundConfig,
    FewImagesConfig,
    NetworkConfig,
    max_num_iterations=200_000,
    num_rays_per_batch=4_096,
    learning_rate=5e-4,
    lr_final=0.1,
    adam_eps=1e-7,
    background="white",
    num_steps=192,
):
    """Settings of vanilla-nerf; the defaults are the paper's."""


def decide(config: VanillaNeRFConfig, scene: Scene) -> tuple[VanillaNeRFConfig, list[Decision]]:
    """Fill in the settings that depend on the scene."""
    config, made = decide_background(config, scene)
    config, few = decide_few_images(config, scene, OPEN_UNTIL)
    config, samples = decide_samples(config, OCCUPANCY_SAMPLES_PER_BATCH)
    return config, made + few + samples


def make_field(config: VanillaNeRFConfig, scene: Scene) -> NeRFField:
    """Return the fine network; the coarse one has the same shape."""
    return _network(config, contracted=contracted_box(config, foreground(config, scene)))


def make_background(config: VanillaNeRFConfig, scene: Scene) -> NeRFField:
    """Return the network for the outside of the sphere, at points of the inverted sphere."""
    return _network(config, dims=4)


def _network(config: VanillaNeRFConfig, contracted: Tensor | None = None, dims: int = 3) -> NeRFField:
    field = NeRFField(
        config.hidden_width,
        config.num_layers,
        skip=config.num_layers // 2 + 1,
        position_frequencies=config.position_frequencies,
        direction_frequencies=config.direction_frequencies,
        contracted=contracted,
        opening=config.open_levels_until,
        dims=dims,
    )
    if config.sampler == "occupancy":
        field.optimised = Optimised(learning_rate=OCCUPANCY_RATE * config.learning_rate)
    return field


def sampler(config: VanillaNeRFConfig, scene: Scene) -> Sampler:
    """Return the configured sampler; the coarse field of hierarchical sampling is built like the fine one."""
    return make_foreground_sampler(config, scene, partial(make_field, config, scene))


class VanillaNeRF(RayModel[VanillaNeRFConfig], plain=True):
    """A model that compares coarse and fine colours with the images (section 5.3)."""

    losses = (COLOR_ERROR, CoarseColorError(), SamplerLoss(), *KNOWN_DISTANCES, *FEW_IMAGES)
    steps_repeat = True


METHOD = Method(
    VanillaNeRFConfig(),
    paper="arXiv:2003.08934",
    field=make_field,
    sampler=sampler,
    renderer=partial(background_renderer, make_field=make_background),
    model=VanillaNeRF,
    decide=decide,
)
