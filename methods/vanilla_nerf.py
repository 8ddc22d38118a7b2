"""NeRF as published in 2020: one large network on frequency encodings, coarse and fine sampling.

Mildenhall et al., "NeRF: Representing Scenes as Neural Radiance Fields for View Synthesis", ECCV 2020. With
`--sampler occupancy` one network of the same shape is sampled through an occupancy grid instead: empty and hidden
space is skipped (as in NerfAcc, Li et al. 2023).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import ClassVar

from framework import Decision, Method, Sampler, Scene
from framework.base.config import Range
from framework.base.decisions import Choice, fill
from framework.base.optimised import Optimised
from framework.fields.nerf import NeRFField
from framework.kernels.frequency import MAX_FREQUENCIES
from framework.samplers.choice import HierarchicalConfig, contracted_box, make_sampler, sampler_choice

OCCUPANCY_SAMPLES_PER_BATCH = 2**12
"""With the occupancy grid the number of samples a ray varies a hundredfold, so the number of rays follows it."""
A_RAY = "the number of samples on a ray varies a hundredfold"
OCCUPANCY_RATE = 2.0
"""Times the learning rate with the occupancy grid. Smaller batches and longer steps (`num_steps`) at twice the rate
reached 22.5 dB on Lego after 90 s on two cores, where 2^13 samples, 512 steps and the paper's rate were at 17."""


@dataclass(frozen=True)
class VanillaNeRFConfig(
    HierarchicalConfig,
    max_num_iterations=200_000,
    num_rays_per_batch=4_096,
    learning_rate=5e-4,
    lr_final=0.1,
    adam_eps=1e-7,
    background="white",
    num_steps=192,
):
    """Settings of vanilla-nerf; the defaults are the paper's."""

    RANGES: ClassVar[dict[str, Range]] = {
        "num_layers": (3, 64),
        "hidden_width": (2, 2**14),
        "position_frequencies": (0, MAX_FREQUENCIES),
        "direction_frequencies": (0, MAX_FREQUENCIES),
    }
    """What these numbers may be."""
    num_layers: int = 8
    """Layers before density."""
    hidden_width: int = 256
    """Features of a layer."""
    position_frequencies: int = 10
    """L of the position's encoding."""
    direction_frequencies: int = 4
    """L of the direction's encoding."""


def decide(config: VanillaNeRFConfig, scene: Scene) -> tuple[VanillaNeRFConfig, list[Decision]]:
    """Return the settings with what the scene decides, and why.

    Args:
        config: settings, some of which may be open.
        scene: facts about the data.
    """
    config, made = fill(config, sampler_choice(config, scene.unbounded))
    if config.sampler != "occupancy":
        return config, made
    config, more = fill(config, Choice("samples_per_batch", OCCUPANCY_SAMPLES_PER_BATCH, A_RAY, "samples a step"))
    return config, made + more


def make_field(config: VanillaNeRFConfig, scene: Scene) -> NeRFField:
    """Return one network; the coarse one is of the same shape.

    Args:
        config: the settings, decided.
        scene: facts about the data.
    """
    field = NeRFField(
        config.hidden_width,
        config.num_layers,
        skip=config.num_layers // 2 + 1,
        position_frequencies=config.position_frequencies,
        direction_frequencies=config.direction_frequencies,
        contracted=contracted_box(config, scene),
    )
    if config.sampler == "occupancy":
        field.optimised = Optimised(learning_rate=OCCUPANCY_RATE * config.learning_rate)
    return field


def sampler(config: VanillaNeRFConfig, scene: Scene) -> Sampler:
    """Return the sampler that is asked for; the coarse field of the paper's is a network like the fine one.

    Args:
        config: the settings, decided.
        scene: facts about the data.
    """
    return make_sampler(config, scene, partial(make_field, config, scene))


METHOD = Method(VanillaNeRFConfig(), paper="arXiv:2003.08934", field=make_field, sampler=sampler, decide=decide)
