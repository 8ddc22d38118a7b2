"""Settings, decisions and pose refinement shared by methods for captures."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Generic, Literal, TypeVar

from torch import Tensor

from nerfloom import (
    ConfigError,
    Decision,
    Field,
    Loss,
    PixelBatch,
    RayModel,
    Renderer,
    Sampler,
    Scene,
)
from nerfloom.base.config import AT_LEAST_0, AUTO, Auto, Range, RayConfig
from nerfloom.base.decisions import Choice, fill, is_open
from nerfloom.base.optimised import Optimised
from nerfloom.cameras.refinement import POSE_REASONS, PoseRefinement
from nerfloom.encodings.hash_grid import HashGridConfig
from nerfloom.samplers.choice import PROPOSAL_SAMPLES, SamplingConfig, decide_samples, sampler_choice, samples_choices

DISTORTION = 2e-3
"""Default weight of the distortion loss in unbounded scenes."""
PAPER_SAMPLES = 64, 64
"""Intervals per ray of each proposal in mip-NeRF 360 and in Zip-NeRF."""
POSE_WARMUP = 512
"""Warm-up steps of the learning rate of poses. Before there is a scene, their gradients are noise, and
Adam would move each camera by about the rate times the square root of the number of steps: half a degree in 100
steps."""
MARCHED_REASON = "marched samples carry no gradient to rays"
"""Reason for not refining inexact poses."""
MARCHED_SAMPLES = 2**16
"""Samples per training step with an occupancy grid, about the number of 2,048 rays with proposals."""


@dataclass(frozen=True)
class RefinedConfig(RayConfig):
    """Settings of a method that may refine the poses of its training cameras."""

    RANGES: ClassVar[dict[str, Range]] = {"camera_learning_rate": AT_LEAST_0}
    camera_optimizer: Auto[Literal["off", "SO3xR3", "SE3"]] = AUTO
    """Refinement of the training cameras' poses. auto: SO3xR3 if a device tracked them, otherwise off. A method that
    learns a density needs --sampler proposal for it; with an occupancy grid, auto is off."""
    camera_learning_rate: float = 1e-3
    """Initial learning rate of the poses."""


@dataclass(frozen=True)
class ProposedConfig(RefinedConfig, SamplingConfig, num_proposal_samples=AUTO, num_nerf_samples=AUTO):
    """Settings of a method that refines poses with proposals; the number of samples suits the time."""


@dataclass(frozen=True)
class CaptureConfig(
    HashGridConfig,
    ProposedConfig,
    num_rays_per_batch=2_048,
    learning_rate=1e-2,
    lr_schedule="hold-exponential",
    lr_final=0.02,
    adam_beta2=0.99,
    adam_eps=1e-15,
    eval_num_rays_per_chunk=4_096,
):
    """Settings of a method for captures on a hash grid."""

    RANGES: ClassVar[dict[str, Range]] = {"distortion_loss_mult": AT_LEAST_0}
    contraction: Auto[bool] = AUTO
    """Whether to contract space outside the box. auto: in unbounded scenes."""
    distortion_loss_mult: Auto[float] = AUTO
    """Weight of the distortion loss. auto: 0.002 in unbounded scenes, otherwise 0."""
    gradient_scaling: Auto[bool] = AUTO
    """Whether to scale down gradients near cameras, by squared distance up to half of the box's edge, against floaters.
    auto: in unbounded scenes."""


RefinedConfigT = TypeVar("RefinedConfigT", bound=RefinedConfig)
CaptureConfigT = TypeVar("CaptureConfigT", bound=CaptureConfig)


def refined_sampler_choice(config: ProposedConfig, contracted: bool) -> Choice:
    """Return the sampler from `sampler_choice`, or proposals if pose refinement is selected.

    Args:
        contracted: whether the field covers space outside the box.
    """
    choice = sampler_choice(config, contracted)
    if config.camera_optimizer in ("SO3xR3", "SE3") and not contracted:
        return replace(choice, value="proposal", reason=f"poses are refined, and {MARCHED_REASON}")
    return choice


def refinement_choice(scene: Scene, marched: bool) -> Choice:
    """Return whether to refine poses.

    Args:
        marched: whether samples carry no gradient to rays.
    """
    refined = "SO3xR3" if scene.poses == "device" and not scene.warped else "off"
    reason = POSE_REASONS[scene.poses]
    if marched and refined != "off":
        refined, reason = "off", MARCHED_REASON
    return Choice("camera_optimizer", refined, reason, "pose refinement")


def decide_capture(
    config: CaptureConfigT, scene: Scene, proposals: tuple[int, ...] = PROPOSAL_SAMPLES
) -> tuple[CaptureConfigT, list[Decision]]:
    """Decide the settings shared by methods for captures.

    Args:
        proposals: intervals of each proposal without a time limit.

    Returns:
        The settings, and a record of each setting that was filled in.
    """
    contracted = scene.unbounded if is_open(config.contraction) else config.contraction
    config, made = fill(config, refined_sampler_choice(config, contracted))
    around = "there may be something outside the box" if contracted else "the scene ends at its box"
    reason = f"contraction is {'on' if contracted else 'off'}"
    config, more = fill(
        config,
        Choice("contraction", contracted, around),
        Choice("distortion_loss_mult", DISTORTION if contracted else 0.0, reason, "distortion loss"),
        Choice("gradient_scaling", contracted, reason, "gradient scaling near cameras"),
        refinement_choice(scene, config.sampler != "proposal"),
    )
    config, samples = decide_samples(config, MARCHED_SAMPLES) if config.contraction else (config, [])
    config, counts = fill(config, *samples_choices(config, proposals))
    return config, made + more + samples + counts * (config.sampler == "proposal")


class RefinedModel(RayModel[RefinedConfigT], Generic[RefinedConfigT]):
    """A model with training poses that can be refined.

    Raises:
        ConfigError: if poses are refined in normalised device coordinates, or by samples that carry no gradient to
            rays.
    """

    def __init__(
        self, config: RefinedConfigT, scene: Scene, field: Field, sampler: Sampler, renderer: Renderer
    ) -> None:
        super().__init__(config, scene, field, sampler, renderer)
        self.poses: PoseRefinement | None = None
        if config.camera_optimizer in ("SO3xR3", "SE3"):
            if scene.warped:
                raise ConfigError("--camera-optimizer: poses cannot be refined in normalised device coordinates")
            if not sampler.carries_gradients:
                raise ConfigError(f"--camera-optimizer needs --sampler proposal: {MARCHED_REASON}")
            self.poses = PoseRefinement(scene.num_cameras, config.camera_optimizer, scene.camera_to_worlds)
            self.poses.optimised = Optimised(
                "poses", config.camera_learning_rate, schedule="exponential", warmup_steps=POSE_WARMUP
            )

    def loss(self, batch: PixelBatch, step: int) -> Loss:
        """Return the terms of `losses` on a batch, from rays that refined poses move.

        Rays without cameras, such as a teacher's, are not moved.
        """
        if self.poses is not None and batch.rays.camera_indices is not None:
            batch = replace(batch, rays=self.poses(batch.rays))
        return super().loss(batch, step)

    def refined_poses(self, poses: Tensor, training: bool) -> Tensor:
        return poses if self.poses is None else self.poses.refined(poses, training)
