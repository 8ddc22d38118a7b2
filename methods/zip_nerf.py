"""Zip-NeRF: a hash grid that sees cones, with multisampling, features weighted by scale, and anti-aliased proposals.

Barron et al., "Zip-NeRF: Anti-Aliased Grid-Based Neural Radiance Fields", ICCV 2023. Sizes are for a processor: tables
of 2^18 entries and grids of up to 2048 cells an axis, where the paper has 2^21 and 8192. The networks are nerfacto's.
Other than in the paper, the loss of colours is the mean squared error, gradients are scaled down near cameras (Philip
and Deschaintre 2023), and an image's exposure is an affine transform of its colours.
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
    RayModel,
    Rays,
    Rendered,
    Renderer,
    Sampler,
    Scene,
)
from framework.base.config import AT_LEAST_0, AUTO, AppearanceConfig, Auto, Range
from framework.base.decisions import Choice, fill
from framework.base.optimised import Optimised
from framework.cameras.refinement import PoseRefinement
from framework.encodings.multisampled import MultisampledHashGrid
from framework.fields.appearance import AFFINE, Appearance, exposed
from framework.fields.multisampled import MultisampledDensity, MultisampledField
from framework.kernels.hash_grid_layout import MAX_LEVELS, MAX_LOG2_TABLE_SIZE, MAX_RESOLUTION
from framework.rendering.losses import normalised_distortion
from framework.samplers.choice import SamplingConfig, make_sampler, sampler_choice
from framework.samplers.proposal import ProposalSampler, half_edge
from framework.scene.reasons import LIGHT_REASONS, POSE_REASONS
from methods.nerfacto import DISTORTION, NerfactoRenderer

DECAY, DECAY_OF_OBJECTS = 0.1, 10.0
"""Default weight of the grids' decay, of captures and of objects before no background: the paper's."""


@dataclass(frozen=True)
class ZipNeRFConfig(
    SamplingConfig,
    AppearanceConfig,
    max_num_iterations=25_000,
    num_rays_per_batch=2_048,
    learning_rate=1e-2,
    lr_schedule="hold-exponential",
    lr_final=0.02,
    adam_beta2=0.99,
    adam_eps=1e-15,
    eval_num_rays_per_chunk=4_096,
    sampler="proposal",
    num_proposal_samples=(64, 64),
):
    """Settings of zip-nerf; those not given depend on the scene."""

    RANGES: ClassVar[dict[str, Range]] = {
        "power_ladder": (-1e3, 1),
        "interlevel_blurs": (1e-6, 1),
        "distortion_loss_mult": AT_LEAST_0,
        "hash_decay_mult": AT_LEAST_0,
        "camera_learning_rate": AT_LEAST_0,
        "exposure_learning_rate": AT_LEAST_0,
        "num_levels": (1, MAX_LEVELS),
        "features_per_level": (1, 64),
        "base_resolution": (1, MAX_RESOLUTION),
        "max_resolution": (1, MAX_RESOLUTION),
        "log2_table_size": (1, MAX_LOG2_TABLE_SIZE),
        "num_proposal_levels": (1, MAX_LEVELS),
        "proposal_resolutions": (1, MAX_RESOLUTION),
        "proposal_log2_table_size": (1, MAX_LOG2_TABLE_SIZE),
        "hidden_width": (1, 2**14),
    }
    """Allowed range of each numeric setting."""
    contraction: Auto[bool] = AUTO
    """Whether space outside the box is contracted. If not given: in unbounded scenes."""
    power_ladder: float = -1.5
    """Exponent of the power ladder by which distances are spaced where space is contracted."""
    interlevel_blurs: tuple[float, ...] = (0.03, 0.003)
    """Radius of the box that blurs the samples' histogram in the loss of each proposal, in normalised distance."""
    distortion_loss_mult: Auto[float] = AUTO
    """Weight of the distortion loss. If not given: nerfacto's 0.002 in unbounded scenes, else 0."""
    hash_decay_mult: Auto[float] = AUTO
    """Weight of the mean square of each level's features. If not given: 0.1, or 10 for objects without background."""
    exposure: Auto[bool] = AUTO
    """Whether each image has an affine transform of colours. If not given: if light or exposure differ between them."""
    exposure_learning_rate: float = 1e-3
    """Initial learning rate of these transforms."""
    camera_optimizer: Literal["auto", "off", "SO3xR3", "SE3"] = "auto"
    """Refinement of the training cameras' poses; auto: SO3xR3 if a device tracked them, else off."""
    camera_learning_rate: float = 1e-3
    """Initial learning rate of the poses."""
    gradient_scaling: Auto[bool] = AUTO
    """Whether gradients near cameras are scaled down, by squared distance up to half of the box's edge, against
    floaters. If not given: in unbounded scenes."""
    num_levels: int = 8
    """Number of levels of the hash grid."""
    features_per_level: int = 4
    """Features per grid vertex."""
    base_resolution: int = 16
    """Cells per axis at the coarsest level of each grid."""
    max_resolution: int = 2_048
    """Cells per axis at the finest level."""
    log2_table_size: int = 18
    """Maximum number of table entries per level, log2."""
    num_proposal_levels: int = 6
    """Number of levels of each proposal's hash grid, which has one feature per vertex."""
    proposal_resolutions: tuple[int, ...] = (512, 2_048)
    """Cells per axis at the finest level of each proposal's hash grid."""
    proposal_log2_table_size: int = 17
    """Maximum number of table entries per level of the proposals' hash grids, log2."""
    sparse_updates: bool = True
    """Whether Adam updates only the table entries that a step used."""
    hidden_width: int = 64
    """Features per hidden layer of the two networks."""

    def __post_init__(self) -> None:
        super().__post_init__()
        counts = {len(self.num_proposal_samples), len(self.proposal_resolutions), len(self.interlevel_blurs)}
        if len(counts) > 1:
            raise ConfigError(
                "--num-proposal-samples, --proposal-resolutions and --interlevel-blurs need one number a proposal each"
            )


class ZipNeRF(RayModel[ZipNeRFConfig]):
    """A model with exposures of images, refined poses and the distortion loss.

    Args:
        config: the method's settings, none left open.
        scene: properties of the data.
        field: density and colour.
        sampler: chooses the samples along rays.
        renderer: turns samples into colours and depths.

    Raises:
        ConfigError: if poses are to be refined in normalised device coordinates or with another sampler than proposals.
    """

    def __init__(self, config: ZipNeRFConfig, scene: Scene, field: Field, sampler: Sampler, renderer: Renderer) -> None:
        super().__init__(config, scene, field, sampler, renderer)
        self.appearance: Appearance | None = None
        if config.exposure:
            rate = config.exposure_learning_rate
            self.appearance = Appearance(AFFINE, scene.num_cameras, Optimised("exposures", rate))
        self.poses: PoseRefinement | None = None
        if config.camera_optimizer in ("SO3xR3", "SE3"):
            if scene.warped:
                raise ConfigError("--camera-optimizer: poses cannot be refined in normalised device coordinates")
            if config.sampler != "proposal":
                raise ConfigError("--camera-optimizer needs --sampler proposal: other samples have no gradient to rays")
            self.poses = PoseRefinement(scene.num_cameras, config.camera_optimizer, scene.camera_to_worlds)
            self.poses.optimised = Optimised("poses", config.camera_learning_rate, schedule="exponential")

    def refined_cameras(self, cameras: Cameras) -> Cameras:
        """Return the training cameras with refined poses, of M `cameras` with the poses of the data."""
        return cameras if self.poses is None else self.poses.refined(cameras)

    def render(self, rays: Rays, background: Tensor) -> Rendered:
        rendered = super().render(rays if self.poses is None else self.poses(rays), background)
        if self.appearance is None:
            return rendered
        vectors = self.appearance(rays.camera_indices, len(rays))
        return replace(rendered, rgb=exposed(rendered.rgb, rendered.accumulation, background, vectors))

    def regularizers(self, rendered: Rendered, batch: PixelBatch, step: int) -> dict[str, Tensor]:
        samples, weights, mult = rendered.samples, rendered.weights, self.config.distortion_loss_mult
        if mult == 0 or samples is None or weights is None or samples.edges is None or not samples.num_rays:
            return {}
        return {"distortion": mult * normalised_distortion(weights, samples)}


def decide(config: ZipNeRFConfig, scene: Scene) -> tuple[ZipNeRFConfig, list[Decision]]:
    """Return `config` with the settings filled in that depend on the `scene`, and a record of each."""
    unbounded = scene.unbounded if config.contraction is None else config.contraction
    config, made = fill(config, sampler_choice(config, unbounded))
    contracted = unbounded and config.sampler == "proposal"
    around = "there may be something outside the box" if contracted else "the scene ends at its box"
    reason = f"contraction is {'on' if contracted else 'off'}"
    behind = "the images tell what is background" if scene.has_alpha else "the images show a background"
    varies, refined = scene.appearance_varies, "SO3xR3" if scene.poses == "device" and not scene.warped else "off"
    config, more = fill(
        config,
        Choice("contraction", contracted, around),
        Choice("distortion_loss_mult", DISTORTION if contracted else 0.0, reason, "distortion loss"),
        Choice("gradient_scaling", contracted, reason, "gradient scaling near cameras"),
        Choice("hash_decay_mult", DECAY_OF_OBJECTS if scene.has_alpha else DECAY, behind, "decay of the grids"),
        Choice("exposure", varies, LIGHT_REASONS[varies], "affine exposures"),
        Choice("camera_optimizer", refined, POSE_REASONS[scene.poses], "pose refinement"),
    )
    return config, made + more


def make_field(config: ZipNeRFConfig, scene: Scene) -> MultisampledField:
    """Return a field of one multisampled hash grid and two small networks, by `config` and `scene`."""
    sizes = config.num_levels, config.features_per_level, config.base_resolution, config.max_resolution
    grid = MultisampledHashGrid(*sizes, config.log2_table_size, config.sparse_updates, config.hash_decay_mult)
    unbounded = config.contraction and config.sampler == "proposal"
    return MultisampledField(scene.box, grid, config.hidden_width, unbounded=unbounded)


def sampler(config: ZipNeRFConfig, scene: Scene) -> Sampler:
    """Return multisampled proposals with the anti-aliased loss for `scene`, or the sampler that `config` names."""
    scene = replace(scene, unbounded=config.contraction)
    if config.sampler != "proposal":
        return make_sampler(config, scene)

    def proposal(finest: int) -> MultisampledDensity:
        sizes = config.num_proposal_levels, 1, config.base_resolution, finest, config.proposal_log2_table_size
        grid = MultisampledHashGrid(*sizes, config.sparse_updates, config.hash_decay_mult)
        return MultisampledDensity(scene.box, grid, unbounded=scene.unbounded)

    made = ProposalSampler(
        scene.box,
        (*config.num_proposal_samples, config.num_nerf_samples),
        unbounded=scene.unbounded,
        endless=scene.unbounded and not scene.has_alpha,
        fields=[proposal(finest) for finest in config.proposal_resolutions],
        ladder=config.power_ladder,
        blurs=config.interlevel_blurs,
    )
    made.samples_per_step = config.samples_per_batch
    return made


def renderer(config: ZipNeRFConfig, scene: Scene) -> Renderer:
    """Return the renderer, with gradient scaling at the size of the `scene` if `config` has it."""
    return NerfactoRenderer(half_edge(scene.box) if config.gradient_scaling else None, None)


METHOD = Method(
    ZipNeRFConfig(),
    paper="arXiv:2304.06706",
    field=make_field,
    sampler=sampler,
    renderer=renderer,
    model=ZipNeRF,
    decide=decide,
)
