"""Mip-NeRF: one network evaluated for cones instead of points, against aliasing between scales.

Barron et al., "Mip-NeRF: A Multiscale Representation for Anti-Aliasing Neural Radiance Fields", ICCV 2021.
`ns-train mip-nerf ... blender --multiscale 4` makes its multiscale Blender images. With `--sampler occupancy`, empty
and hidden space is skipped, as in vanilla-nerf.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from nerfloom import Decision, Field, Method, RayModel, Sampler, Scene
from nerfloom.base.config import Range
from nerfloom.base.optimised import Optimised
from nerfloom.encodings.integrated import IntegratedEncoding
from nerfloom.fields.integrated import IntegratedField
from nerfloom.fields.nerf import NetworkConfig
from nerfloom.kernels.encodings.frequency import MAX_FREQUENCIES
from nerfloom.losses.terms import COLOR_ERROR, KNOWN_DISTANCES, CoarseColorError, SamplerLoss
from nerfloom.methods.vanilla_nerf import OCCUPANCY_RATE, OCCUPANCY_SAMPLES_PER_BATCH
from nerfloom.samplers.choice import HierarchicalConfig, contracted_box, decide_sampler, decide_samples, make_sampler


@dataclass(frozen=True)
class MipNeRFConfig(
    HierarchicalConfig,
    NetworkConfig,
    max_num_iterations=1_000_000,
    num_rays_per_batch=4_096,
    learning_rate=5e-4,
    lr_final=0.01,
    background="white",
    num_coarse_samples=128,
    num_fine_samples=128,
    num_steps=192,
):
    """Settings of mip-nerf; the defaults are the paper's, without its warm-up of 2500 steps."""

    RANGES: ClassVar[dict[str, Range]] = {"position_frequencies": (1, MAX_FREQUENCIES)}
    position_frequencies: int = 16
    """Number of frequencies in the integrated encoding of positions; frequencies finer than a cone average to 0."""


class MipNeRF(RayModel[MipNeRFConfig], plain=True):
    """A model with the weight 0.1 for the coarse level, the same network on the same rays (section 3.3)."""

    losses = (COLOR_ERROR, CoarseColorError(0.1), SamplerLoss(), *KNOWN_DISTANCES)
    steps_repeat = True


def decide(config: MipNeRFConfig, scene: Scene) -> tuple[MipNeRFConfig, list[Decision]]:
    """Fill in the settings that depend on the scene."""
    config, made = decide_sampler(config, scene)
    config, samples = decide_samples(config, OCCUPANCY_SAMPLES_PER_BATCH)
    return config, made + samples


def make_field(config: MipNeRFConfig, scene: Scene) -> Field:
    """Return a network like NeRF's on the integrated encoding."""
    contracted = contracted_box(config, scene) is not None
    field = IntegratedField(
        IntegratedEncoding.of_images(scene, config.position_frequencies, contracted),
        config.hidden_width,
        config.num_layers,
        skip=config.num_layers // 2 + 1,
        direction_frequencies=config.direction_frequencies,
    )
    if config.sampler == "occupancy":
        field.optimised = Optimised(learning_rate=OCCUPANCY_RATE * config.learning_rate)
    return field


def sampler(config: MipNeRFConfig, scene: Scene) -> Sampler:
    """Return the configured sampler; the coarse level of hierarchical sampling is the field itself."""
    return make_sampler(config, scene, make_coarse=lambda: None)


METHOD = Method(
    MipNeRFConfig(), paper="arXiv:2103.13415", field=make_field, sampler=sampler, model=MipNeRF, decide=decide
)
