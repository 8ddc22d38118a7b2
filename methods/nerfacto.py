"""Nerfacto: what works on real captures, put together: hash grid, contraction, proposals, and what a scene asks for.

Tancik et al., "Nerfstudio: A Modular Framework for Neural Radiance Field Development", SIGGRAPH 2023, section 4. The
parts: hash grid (Mueller et al. 2022); contraction, proposals and distortion loss (Barron et al. 2022); appearance
vectors (Martin-Brualla et al. 2021); gradients scaled near cameras (Philip and Deschaintre 2023).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

from torch import Tensor

from framework import Batch, ConfigError, Decision, Method, Model, Rays, Rendered, Scene
from framework.base.config import AT_LEAST_0, Range
from framework.cameras.refinement import PoseRefinement
from framework.encodings.hash_grid import HashGrid
from framework.fields.encoded import EncodedField
from framework.fields.normals import NormalHead, density_normals, normal_penalties
from framework.geometry.rays import Samples
from framework.kernels.compositing import distortion, ray_sum
from framework.kernels.hash_grid import MAX_LEVELS, MAX_LOG2_TABLE_SIZE, MAX_RESOLUTION
from framework.rendering.losses import depth_error
from framework.rendering.volume import shade
from framework.samplers.choice import SamplingConfig, contracted_box, make_sampler, sampler_decisions
from framework.samplers.proposal import ProposalSampler, half_edge

APPEARANCE_SIZE = 16
DISTORTION = 2e-3
DEPTH = 0.1
POSE_REASONS = {
    "exact": "the poses are exact",
    "photographs": "the poses were found in the photographs themselves",
    "device": "the poses are those that the device tracked",
}


@dataclass(frozen=True)
class NerfactoConfig(SamplingConfig):
    """Settings of nerfacto. What is not given is decided by the scene."""

    RANGES: ClassVar[dict[str, Range]] = {
        "distortion_loss_mult": AT_LEAST_0,
        "appearance_embedding_dim": (0, 2**10),
        "camera_learning_rate": AT_LEAST_0,
        "depth_loss_mult": AT_LEAST_0,
        "orientation_loss_mult": AT_LEAST_0,
        "num_levels": (1, MAX_LEVELS),
        "features_per_level": (1, 64),
        "base_resolution": (1, MAX_RESOLUTION),
        "max_resolution": (1, MAX_RESOLUTION),
        "log2_table_size": (1, MAX_LOG2_TABLE_SIZE),
        "hidden_width": (1, 2**14),
    }
    """What these numbers may be."""
    max_num_iterations: int = 30_000
    num_rays_per_batch: int = 2_048
    learning_rate: float = 1e-2
    lr_schedule: Literal["constant", "exponential", "cosine", "hold-exponential"] = "hold-exponential"
    lr_final: float = 0.02
    adam_beta2: float = 0.99
    adam_eps: float = 1e-15
    eval_num_rays_per_chunk: int = 4_096
    sampler: Literal["auto", "occupancy", "proposal"] = "proposal"
    contraction: bool | None = None
    """Contract all of space around the box. If not given: where there may be something outside it."""
    distortion_loss_mult: float | None = None
    """Weight of the distortion loss. If not given: 0.002 for unbounded scenes, else none."""
    appearance_embedding_dim: int | None = None
    """Features in which each photograph may differ. If not given: 16 where light differs between them, else none."""
    camera_optimizer: Literal["auto", "off", "SO3xR3", "SE3"] = "auto"
    """Refine the training cameras' poses; auto: SO3xR3 where a device tracked them."""
    camera_learning_rate: float = 1e-3
    """Of the poses."""
    depth_loss_mult: float | None = None
    """Weight of how far light comes from, against depth images. If not given: 0.1 where there are any, else none."""
    predict_normals: bool = False
    """Learn normals too, as the density's gradient has them but smoother."""
    orientation_loss_mult: float = 0.1
    """Weight of predicted normals that face away from where they are seen, relative to their distance from the
    density's."""
    gradient_scaling: bool | None = None
    """Gradients grow with squared distance up to half of the box's edge, against floaters at cameras. If not given: for
    unbounded scenes."""
    num_levels: int = 16
    """Resolutions of the hash grid."""
    features_per_level: int = 2
    """Features stored at a grid vertex."""
    base_resolution: int = 16
    """Cells along an axis at the coarsest level."""
    max_resolution: int = 2_048
    """Cells along an axis at the finest level."""
    log2_table_size: int = 18
    """Entries of a level's table at most, as a power of two."""
    sparse_updates: bool = True
    """Adam updates only the table entries that a step used."""
    hidden_width: int = 64
    """Features of a layer of the two networks."""


class Nerfacto(Model[NerfactoConfig]):
    """One hash field, sampled where proposals say."""

    runs_on_kernels = True
    learns_appearance = refines_poses = True

    def __init__(self, config: NerfactoConfig, scene: Scene) -> None:
        if config.contraction is not None:
            scene = replace(scene, unbounded=config.contraction)
        super().__init__(config, scene)
        self.unbounded = contracted_box(config, scene) is not None
        grid = HashGrid(
            config.num_levels,
            config.features_per_level,
            config.base_resolution,
            config.max_resolution,
            config.log2_table_size,
            config.sparse_updates,
        )
        self.field = EncodedField(
            scene.box,
            grid,
            config.hidden_width,
            unbounded=self.unbounded,
            appearance=(self.appearance_size, scene.num_cameras) if self.appearance_size else None,
        )
        self.sampler = make_sampler(config, scene)
        self.unit_length = half_edge(scene.box)
        self.normals = NormalHead(self.field.num_features, config.hidden_width) if config.predict_normals else None
        group, given = self.pose_group, scene.camera_to_worlds
        self.poses = None if group == "off" else PoseRefinement(scene.num_cameras, group, given)
        if self.poses is not None and scene.warped:
            raise ConfigError("--camera-optimizer: poses cannot be refined in normalised device coordinates")
        if self.poses is not None and not isinstance(self.sampler, ProposalSampler):
            raise ConfigError("--camera-optimizer needs --sampler proposal: marched samples carry no gradient to rays")

    # -- what the scene decides -------------------------------------------------------------------------------

    @property
    def appearance_size(self) -> int:
        asked = self.config.appearance_embedding_dim
        return (APPEARANCE_SIZE if self.scene.appearance_varies else 0) if asked is None else asked

    @property
    def pose_group(self) -> Literal["off", "SO3xR3", "SE3"]:
        asked = self.config.camera_optimizer
        if asked == "auto":
            return "SO3xR3" if self.scene.poses == "device" and not self.scene.warped else "off"
        return asked

    @property
    def distortion_mult(self) -> float:
        asked = self.config.distortion_loss_mult
        return (DISTORTION if self.unbounded else 0.0) if asked is None else asked

    @property
    def depth_mult(self) -> float:
        asked = self.config.depth_loss_mult
        return (DEPTH if self.scene.has_depth else 0.0) if asked is None else asked

    @property
    def scales_gradients(self) -> bool:
        asked = self.config.gradient_scaling
        return self.unbounded if asked is None else asked

    def decisions(self) -> list[Decision]:
        config, found = self.config, sampler_decisions(self.config, self.scene)
        if config.contraction is None:
            reason = "there may be something outside the box" if self.unbounded else "the scene ends at its box"
            found.append(Decision("contraction", _on(self.unbounded), reason))
        reason = f"contraction is {_on(self.unbounded)}"
        if config.distortion_loss_mult is None:
            found.append(Decision("distortion loss", f"{self.distortion_mult:g}", reason))
        if config.gradient_scaling is None:
            found.append(Decision("gradient scaling near cameras", _on(self.scales_gradients), reason))
        if config.appearance_embedding_dim is None:
            varies = self.scene.appearance_varies
            reason = "light differs between the photographs" if varies else "the photographs are lit alike"
            found.append(Decision("appearance features", f"{self.appearance_size}", reason))
        if config.depth_loss_mult is None and self.scene.has_depth:
            found.append(Decision("depth loss", f"{self.depth_mult:g}", "there are depth images"))
        if config.camera_optimizer == "auto":
            found.append(Decision("pose refinement", self.pose_group, POSE_REASONS[self.scene.poses]))
        return found

    # -- rendering and learning -------------------------------------------------------------------------------

    def render(self, rays: Rays, background: Tensor) -> Rendered:
        if self.poses is not None:
            rays = self.poses(rays)
        samples = self.sampler.sample(rays, self.field, self.training)
        if samples.sigma is None or samples.features is None:
            samples = samples.evaluated(*self.field.density(samples.positions(rays), samples.times(rays)))
        factors = None
        if self.training and self.scales_gradients:
            factors = (samples.t / self.unit_length).square().clamp(max=1)
        rendered = shade(self.field, rays, samples, background, factors)
        return rendered if self.normals is None else self._with_normals(self.normals, rays, rendered)

    def _with_normals(self, head: NormalHead, rays: Rays, rendered: Rendered) -> Rendered:
        """Normals in the picture, and in training what is wrong with them."""
        samples, weights = rendered.samples, rendered.weights
        assert samples is not None
        assert samples.features is not None
        assert weights is not None
        positions = samples.positions(rays).detach()
        predicted = head(samples.features.detach(), 2 * self.field.unit(positions) - 1)
        facing = ray_sum(weights.detach()[:, None] * predicted, samples)
        if not self.training:
            return replace(rendered, normals=facing)
        found = density_normals(self.field, positions, samples.times(rays))
        directions = rays.directions.detach().index_select(0, samples.ray_indices)
        penalties = normal_penalties(predicted, found, directions, weights, samples)
        return replace(rendered, normals=facing, penalties=penalties)

    def before_step(self, step: int, progress: float) -> None:
        self.sampler.update(step, self.field.density)

    def loss(self, rendered: Rendered, batch: Batch, step: int) -> dict[str, Tensor]:
        losses = super().loss(rendered, batch, step)
        samples, weights = rendered.samples, rendered.weights
        if samples is None or weights is None or not samples.num_rays:
            return losses
        if self.distortion_mult > 0 and samples.edges is not None:
            normalised = Samples.regular(samples.edges[:, :-1], samples.edges[:, 1:])
            losses["distortion"] = self.distortion_mult * distortion(weights, normalised).mean()
        if self.depth_mult > 0 and batch.distances is not None:
            known = batch.distances.repeat_interleave(samples.num_rays // len(batch.distances))
            losses["depth"] = self.depth_mult * depth_error(weights, samples, known)
        for name, found in rendered.penalties.items():
            losses[name] = (self.config.orientation_loss_mult if name == "orientation" else 1.0) * found.mean()
        return losses

    def param_groups(self) -> list[dict[str, Any]]:
        groups = super().param_groups()
        if self.poses is None:
            return groups
        tangents = self.poses.tangents
        groups[0]["params"] = [p for p in groups[0]["params"] if p is not tangents]
        return [
            *groups,
            {"params": [tangents], "lr": self.config.camera_learning_rate, "schedule": "exponential", "name": "poses"},
        ]


def _on(choice: bool) -> str:
    return "on" if choice else "off"


METHOD = Method(Nerfacto, NerfactoConfig(), paper="arXiv:2302.04264")
