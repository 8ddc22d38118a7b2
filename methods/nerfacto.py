"""Nerfacto: what works on real captures, put together: hash grid, contraction, proposals, and what a scene asks for.

Tancik et al., "Nerfstudio: A Modular Framework for Neural Radiance Field Development", SIGGRAPH 2023, section 4. The
parts: hash grid (Mueller et al. 2022); contraction, proposals and distortion loss (Barron et al. 2022); appearance
vectors (Martin-Brualla et al. 2021); gradients scaled near cameras (Philip and Deschaintre 2023).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

from torch import Tensor

from framework import Batch, Decision, Method, Model, Rays, Rendered, Scene, TrainConfig
from framework.encodings import HashGrid
from framework.fields.encoded import EncodedField
from framework.fields.normals import NormalHead, density_normals, normal_penalties
from framework.kernels.compositing import distortion, ray_sum
from framework.kernels.math import scale_gradient
from framework.pose_refinement import PoseRefinement
from framework.rays import Samples
from framework.renderers import volume_render
from framework.samplers.proposal import ProposalSampler

APPEARANCE_SIZE = 16
DISTORTION = 2e-3
POSE_REASONS = {
    "exact": "the poses are exact",
    "photographs": "the poses were found in the photographs themselves",
    "device": "the poses are those that the device tracked",
}


@dataclass(frozen=True)
class NerfactoConfig(TrainConfig):
    """Settings of nerfacto. What is not given is decided by the scene."""

    max_num_iterations: int = 30_000
    num_rays_per_batch: int = 2_048
    learning_rate: float = 1e-2
    lr_schedule: Literal["constant", "exponential", "cosine", "hold-exponential"] = "hold-exponential"
    lr_final: float = 0.02
    adam_beta2: float = 0.99
    adam_eps: float = 1e-15
    eval_num_rays_per_chunk: int = 4_096
    contraction: bool | None = None
    """Contract all of space around the box. If not given: where there may be something outside it."""
    num_proposal_samples: tuple[int, ...] = (128, 64)
    """Intervals of each proposal."""
    num_nerf_samples: int = 32
    """Samples a ray of the field itself."""
    interlevel_loss_mult: float = 1.0
    """Weight of what teaches the proposals."""
    distortion_loss_mult: float | None = None
    """Weight of the distortion loss. If not given: 0.002 for unbounded scenes, else none."""
    appearance_embedding_dim: int | None = None
    """Features in which each photograph may differ. If not given: 16 where light differs between them, else none."""
    camera_optimizer: Literal["auto", "off", "SO3xR3", "SE3"] = "auto"
    """Refine the training cameras' poses; auto: SO3xR3 where a device tracked them."""
    camera_learning_rate: float = 1e-3
    """Of the poses."""
    predict_normals: bool = False
    """Learn normals too, as the density's gradient has them but smoother."""
    normal_loss_mult: float = 1e-3
    """Weight of the predicted normals' distance from the density's."""
    orientation_loss_mult: float = 1e-4
    """Weight of predicted normals that face away from where they are seen."""
    gradient_scaling: bool | None = None
    """Gradients grow with squared distance up to 1, against floaters at cameras. If not given: for unbounded scenes."""
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

    def __init__(self, config: NerfactoConfig, scene: Scene) -> None:
        super().__init__(config, scene)
        self.unbounded = scene.unbounded if config.contraction is None else config.contraction
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
        counts = (*config.num_proposal_samples, config.num_nerf_samples)
        resolutions = tuple(128 << level for level in range(len(config.num_proposal_samples)))
        endless = self.unbounded and not scene.has_alpha
        self.sampler = ProposalSampler(scene.box, counts, resolutions, self.unbounded, endless)
        self.normals = NormalHead(self.field.num_features, config.hidden_width) if config.predict_normals else None
        self.poses = None if self.pose_group == "off" else PoseRefinement(scene.num_cameras, self.pose_group)

    # -- what the scene decides -------------------------------------------------------------------------------

    @property
    def appearance_size(self) -> int:
        asked = self.config.appearance_embedding_dim
        return (APPEARANCE_SIZE if self.scene.appearance_varies else 0) if asked is None else asked

    @property
    def pose_group(self) -> Literal["off", "SO3xR3", "SE3"]:
        asked = self.config.camera_optimizer
        return ("SO3xR3" if self.scene.poses == "device" else "off") if asked == "auto" else asked

    @property
    def distortion_mult(self) -> float:
        asked = self.config.distortion_loss_mult
        return (DISTORTION if self.unbounded else 0.0) if asked is None else asked

    @property
    def scales_gradients(self) -> bool:
        asked = self.config.gradient_scaling
        return self.unbounded if asked is None else asked

    def decisions(self) -> list[Decision]:
        config, outside = self.config, "the scene goes on outside its box"
        inside = "the scene ends at its box"
        found = []
        if config.contraction is None:
            found.append(Decision("contraction", _on(self.unbounded), outside if self.unbounded else inside))
        where = outside if self.unbounded else inside
        if config.distortion_loss_mult is None:
            found.append(Decision("distortion loss", f"{self.distortion_mult:g}", where))
        if config.gradient_scaling is None:
            found.append(Decision("gradient scaling near cameras", _on(self.scales_gradients), where))
        if config.appearance_embedding_dim is None:
            varies = self.scene.appearance_varies
            reason = "light differs between the photographs" if varies else "the photographs are lit alike"
            found.append(Decision("appearance features", f"{self.appearance_size}", reason))
        if config.camera_optimizer == "auto":
            found.append(Decision("pose refinement", self.pose_group, POSE_REASONS[self.scene.poses]))
        return found

    # -- rendering and learning -------------------------------------------------------------------------------

    def render(self, rays: Rays, background: Tensor) -> Rendered:
        if self.poses is not None:
            rays = self.poses(rays)
        samples = self.sampler.sample(rays, self.field, self.training)
        positions, times = samples.positions(rays), samples.times(rays)
        sigma, features = self.field.density(positions, times)
        owners = samples.ray_indices
        directions = rays.directions.index_select(0, owners)
        cameras = None if rays.camera_indices is None else rays.camera_indices[owners]
        rgb = self.field.color(features, directions, cameras)
        if self.training and self.scales_gradients:
            factors = samples.t.square().clamp(max=1)
            sigma, rgb = scale_gradient(sigma, factors), scale_gradient(rgb, factors)
        rendered = volume_render(rays, samples, sigma, rgb, background)
        if self.normals is None or rendered.weights is None:
            return rendered
        unit = self.field.unit(positions.detach())
        predicted, weights = self.normals(features.detach(), 2 * unit - 1), rendered.weights
        facing = ray_sum(weights.detach()[:, None] * predicted, samples)
        if not self.training:
            return replace(rendered, normals=facing)
        found = density_normals(self.field, positions, times)
        penalties = normal_penalties(predicted, found, directions.detach(), weights, samples)
        return replace(rendered, normals=facing, penalties=penalties)

    def before_step(self, step: int, progress: float) -> None:
        self.sampler.update(step, self.field.density)

    def loss(self, rendered: Rendered, batch: Batch, step: int) -> dict[str, Tensor]:
        losses = super().loss(rendered, batch, step)
        samples, weights = rendered.samples, rendered.weights
        assert samples is not None
        assert samples.edges is not None
        assert weights is not None
        if "interlevel" in losses:
            losses["interlevel"] = self.config.interlevel_loss_mult * losses["interlevel"]
        if self.distortion_mult > 0 and samples.num_rays:
            normalised = Samples.regular(samples.edges[:, :-1], samples.edges[:, 1:])
            losses["distortion"] = self.distortion_mult * distortion(weights, normalised).mean()
        factors = {"normals": self.config.normal_loss_mult, "orientation": self.config.orientation_loss_mult}
        if samples.num_rays:
            losses |= {name: factors[name] * found.mean() for name, found in rendered.penalties.items()}
        return losses

    def param_groups(self) -> list[dict[str, Any]]:
        groups = super().param_groups()
        if self.poses is None:
            return groups
        tangents = self.poses.tangents
        groups[0]["params"] = [p for p in groups[0]["params"] if p is not tangents]
        return [*groups, {"params": [tangents], "lr": self.config.camera_learning_rate, "name": "poses"}]


def _on(choice: bool) -> str:
    return "on" if choice else "off"


METHOD = Method(Nerfacto, NerfactoConfig(), paper="arXiv:2302.04264")
