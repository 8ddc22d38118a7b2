"""Nerfacto: hash grid, contraction and proposal sampling for real captures; further parts depend on the data.

Tancik et al., "Nerfstudio: A Modular Framework for Neural Radiance Field Development", SIGGRAPH 2023, section 4. Its
parts: hash grid (Mueller et al. 2022); contraction, proposals and distortion loss (Barron et al. 2022); appearance
vectors (Martin-Brualla et al. 2021); gradients scaled near cameras (Philip and Deschaintre 2023).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Literal

from torch import Tensor

from framework import (
    Cameras,
    ConfigError,
    Decision,
    Field,
    Method,
    PixelBatch,
    Points,
    RayModel,
    Rays,
    Rendered,
    Renderer,
    Sampler,
    Samples,
    Scene,
)
from framework.base.config import AT_LEAST_0, AUTO, AppearanceConfig, Auto, Range
from framework.base.decisions import Choice, fill
from framework.base.optimised import Optimised
from framework.cameras.refinement import PoseRefinement
from framework.encodings.hash_grid import HashGrid
from framework.fields.appearance import Appearance
from framework.fields.encoded import NUM_FEATURES, EncodedField
from framework.fields.normals import NormalHead, density_normals, normal_penalties
from framework.kernels.compositing import ray_sum
from framework.kernels.hash_grid_layout import MAX_LEVELS, MAX_LOG2_TABLE_SIZE, MAX_RESOLUTION
from framework.rendering.losses import normalised_distortion
from framework.rendering.volume import VolumeRenderer, shade
from framework.samplers.choice import SamplingConfig, make_sampler, sampler_choice
from framework.samplers.proposal import half_edge
from framework.scene.few_images import FewImagesConfig, decide_few_images
from framework.scene.reasons import LIGHT_REASONS, POSE_REASONS

APPEARANCE_SIZE = 16
"""Default length of appearance vectors where the appearance varies."""
DISTORTION = 2e-3
"""Default weight of the distortion loss in unbounded scenes."""
MARCHED_SAMPLES = 2**16
"""Samples a training step with an occupancy grid: as many as 2,048 rays have with proposals."""
A_RAY = "the number of samples on a ray varies a hundredfold"


@dataclass(frozen=True)
class NerfactoConfig(
    SamplingConfig,
    FewImagesConfig,
    AppearanceConfig,
    max_num_iterations=30_000,
    num_rays_per_batch=2_048,
    learning_rate=1e-2,
    lr_schedule="hold-exponential",
    lr_final=0.02,
    adam_beta2=0.99,
    adam_eps=1e-15,
    eval_num_rays_per_chunk=4_096,
    sampler="proposal",
):
    """Settings of nerfacto; those not given depend on the scene."""

    RANGES: ClassVar[dict[str, Range]] = {
        "distortion_loss_mult": AT_LEAST_0,
        "appearance_embedding_dim": (0, 2**10),
        "camera_learning_rate": AT_LEAST_0,
        "orientation_loss_mult": AT_LEAST_0,
        "num_levels": (1, MAX_LEVELS),
        "features_per_level": (1, 64),
        "base_resolution": (1, MAX_RESOLUTION),
        "max_resolution": (1, MAX_RESOLUTION),
        "log2_table_size": (1, MAX_LOG2_TABLE_SIZE),
        "hidden_width": (1, 2**14),
    }
    """Allowed range of each numeric setting."""
    contraction: Auto[bool] = AUTO
    """Whether space outside the box is contracted. If not given: in unbounded scenes."""
    distortion_loss_mult: Auto[float] = AUTO
    """Weight of the distortion loss. If not given: 0.002 in unbounded scenes, else 0."""
    appearance_embedding_dim: Auto[int] = AUTO
    """Length of each image's appearance vector. If not given: 16 if light or exposure differ between images, else 0."""
    camera_optimizer: Literal["auto", "off", "SO3xR3", "SE3"] = "auto"
    """Refinement of the training cameras' poses; auto: SO3xR3 if a device tracked them, else off."""
    camera_learning_rate: float = 1e-3
    """Initial learning rate of the poses."""
    predict_normals: bool = False
    """Whether to predict normals, which are smoother than those of the density's gradient."""
    orientation_loss_mult: float = 0.1
    """Weight of the penalty on predicted normals that face away from the camera, relative to that on their difference
    from the density's normals."""
    gradient_scaling: Auto[bool] = AUTO
    """Whether gradients near cameras are scaled down, by squared distance up to half of the box's edge, against
    floaters. If not given: in unbounded scenes."""
    num_levels: int = 16
    """Number of levels of the hash grid."""
    features_per_level: int = 2
    """Features per grid vertex."""
    base_resolution: int = 16
    """Cells per axis at the coarsest level."""
    max_resolution: int = 2_048
    """Cells per axis at the finest level."""
    log2_table_size: int = 18
    """Maximum number of table entries per level, log2."""
    sparse_updates: bool = True
    """Whether Adam updates only the table entries that a step used."""
    hidden_width: int = 64
    """Features per hidden layer of the two networks."""


class NerfactoRenderer(VolumeRenderer):
    """Volume rendering with optional gradient scaling near cameras and optional predicted normals.

    Args:
        unit_length: distance from the camera up to which gradients are scaled, scene units; None for no scaling.
        normals: the network that predicts normals; None for no normals.
    """

    def __init__(self, unit_length: float | None, normals: NormalHead | None) -> None:
        super().__init__()
        self.unit_length, self.normals = unit_length, normals

    def shade(self, rays: Rays, samples: Samples, field: Field, background: Tensor) -> Rendered:
        factors = None
        if self.training and self.unit_length is not None:
            factors = (samples.t / self.unit_length).square().clamp(max=1)
        rendered = shade(rays, samples, field, background, factors)
        return rendered if self.normals is None else self._with_normals(self.normals, field, rays, samples, rendered)

    def _with_normals(
        self, head: NormalHead, field: Field, rays: Rays, samples: Samples, rendered: Rendered
    ) -> Rendered:
        """Return `rendered` with normals, and in training with their penalties."""
        assert isinstance(field, EncodedField)
        assert samples.features is not None
        assert rendered.weights is not None
        points, weights = Points(samples.positions(rays).detach(), samples.times(rays)), rendered.weights
        predicted = head(samples.features.detach(), 2 * field.unit(points.positions) - 1)
        facing = ray_sum(weights.detach()[:, None] * predicted, samples)
        if not self.training:
            return replace(rendered, normals=facing)
        target = density_normals(field, points)
        directions = rays.directions.detach().index_select(0, samples.ray_indices)
        penalties = normal_penalties(predicted, target, directions, weights, samples)
        return replace(rendered, normals=facing, penalties=penalties)


class Nerfacto(RayModel[NerfactoConfig]):
    """A model whose training poses can be refined, with appearance vectors and a distortion loss.

    Args:
        config: the method's settings, none left open.
        scene: properties of the data.
        field: density and colour.
        sampler: chooses the samples along rays.
        renderer: turns samples into colours and depths.

    Raises:
        ConfigError: if poses are to be refined in normalised device coordinates or with another sampler than proposals.
    """

    def __init__(
        self, config: NerfactoConfig, scene: Scene, field: Field, sampler: Sampler, renderer: Renderer
    ) -> None:
        super().__init__(config, scene, field, sampler, renderer)
        self.poses: PoseRefinement | None = None
        if config.camera_optimizer in ("SO3xR3", "SE3"):
            if scene.warped:
                raise ConfigError("--camera-optimizer: poses cannot be refined in normalised device coordinates")
            if config.sampler != "proposal":
                raise ConfigError(
                    "--camera-optimizer needs --sampler proposal: marched samples carry no gradient to rays"
                )
            self.poses = PoseRefinement(scene.num_cameras, config.camera_optimizer, scene.camera_to_worlds)
            self.poses.optimised = Optimised("poses", config.camera_learning_rate, schedule="exponential")

    @property
    def appearance(self) -> Appearance | None:
        """Appearance vectors of the training images; None if there are none."""
        return self.field.appearance if isinstance(self.field, EncodedField) else None

    def refined_cameras(self, cameras: Cameras) -> Cameras:
        """Return the training cameras with refined poses.

        Args:
            cameras: M training cameras with the poses of the data.
        """
        return cameras if self.poses is None else self.poses.refined(cameras)

    def render(self, rays: Rays, background: Tensor) -> Rendered:
        return super().render(rays if self.poses is None else self.poses(rays), background)

    def regularizers(self, rendered: Rendered, batch: PixelBatch, step: int) -> dict[str, Tensor]:
        config, samples, weights = self.config, rendered.samples, rendered.weights
        losses: dict[str, Tensor] = {}
        if samples is None or weights is None or not samples.num_rays:
            return losses
        if config.distortion_loss_mult > 0 and (samples.edges is not None or config.contraction):
            scale = None if samples.edges is not None else half_edge(self.scene.box)
            losses["distortion"] = config.distortion_loss_mult * normalised_distortion(weights, samples, scale)
        for name, penalty in rendered.penalties.items():
            losses[name] = (config.orientation_loss_mult if name == "orientation" else 1.0) * penalty.mean()
        return losses


def decide(config: NerfactoConfig, scene: Scene) -> tuple[NerfactoConfig, list[Decision]]:
    """Fill in the settings that depend on the scene.

    Args:
        config: the method's settings; those left open are filled in.
        scene: properties of the data.

    Returns:
        Settings without open ones, and a record of each that was filled in.
    """
    contracted = scene.unbounded if config.contraction is None else config.contraction
    config, made = fill(config, sampler_choice(config, contracted))
    reason = f"contraction is {'on' if contracted else 'off'}"
    refined = "SO3xR3" if scene.poses == "device" and not scene.warped else "off"
    around = "there may be something outside the box" if contracted else "the scene ends at its box"
    config, more = fill(
        config,
        Choice("contraction", contracted, around),
        Choice("distortion_loss_mult", DISTORTION if contracted else 0.0, reason, "distortion loss"),
        Choice("gradient_scaling", contracted, reason, "gradient scaling near cameras"),
        Choice(
            "appearance_embedding_dim",
            APPEARANCE_SIZE if scene.appearance_varies else 0,
            LIGHT_REASONS[scene.appearance_varies],
            "appearance features",
        ),
        Choice("camera_optimizer", refined, POSE_REASONS[scene.poses], "pose refinement"),
    )
    if contracted and config.sampler == "occupancy":
        config, count = fill(config, Choice("samples_per_batch", MARCHED_SAMPLES, A_RAY, "samples a step"))
        more += count
    config, few = decide_few_images(config, scene)
    return config, made + more + few


def make_field(config: NerfactoConfig, scene: Scene) -> EncodedField:
    """Return a field of one hash grid and two small networks, with appearance vectors if their length is not 0.

    Args:
        config: the method's settings, none left open.
        scene: properties of the data.
    """
    grid = HashGrid(
        config.num_levels,
        config.features_per_level,
        config.base_resolution,
        config.max_resolution,
        config.log2_table_size,
        config.sparse_updates,
        opening=config.open_levels_until > 0,
    )
    size = config.appearance_embedding_dim
    return EncodedField(
        scene.box,
        grid,
        config.hidden_width,
        unbounded=config.contraction,
        appearance=(size, scene.num_cameras) if size else None,
        opening=config.open_levels_until > 0,
    )


def sampler(config: NerfactoConfig, scene: Scene) -> Sampler:
    """Return the configured sampler, over all of space if it is contracted.

    Args:
        config: the method's settings, none left open.
        scene: properties of the data.
    """
    return make_sampler(config, replace(scene, unbounded=config.contraction))


def renderer(config: NerfactoConfig, scene: Scene) -> Renderer:
    """Return the renderer, with gradient scaling and predicted normals as configured.

    Args:
        config: the method's settings, none left open.
        scene: properties of the data.
    """
    normals = NormalHead(NUM_FEATURES, config.hidden_width) if config.predict_normals else None
    return NerfactoRenderer(half_edge(scene.box) if config.gradient_scaling else None, normals)


METHOD = Method(
    NerfactoConfig(),
    paper="arXiv:2302.04264",
    field=make_field,
    sampler=sampler,
    renderer=renderer,
    model=Nerfacto,
    decide=decide,
)
