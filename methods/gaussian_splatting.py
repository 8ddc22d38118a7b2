"""3D Gaussian Splatting: a scene of coloured Gaussians, drawn in real time.

Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering", SIGGRAPH 2023. Gaussians grow by
gradients, or are moved as in Kheradmand et al., "3D Gaussian Splatting as Markov Chain Monte Carlo", NeurIPS 2024.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal, TypeVar

import torch
from torch import Tensor

from nerfloom import Decision, GaussianModel, Loss, Method, Optimised, Scene, ViewBatch
from nerfloom.base.config import AT_LEAST_0, AUTO, Auto, Range
from nerfloom.base.console import say
from nerfloom.base.decisions import Choice, fill
from nerfloom.base.device import HostValue
from nerfloom.cameras.refinement import POSE_REASONS, PoseRefinement
from nerfloom.data.dataset import Dataset
from nerfloom.export.surfaces import found_surfaces
from nerfloom.kernels.images.ssim import photometric_loss
from nerfloom.kernels.splats.blend import CHANNELS
from nerfloom.losses.functions import mean_depth_error
from nerfloom.method import DEPTH_REASONS
from nerfloom.registry import load_method
from nerfloom.splats.clear_space import clear_radii, in_clear_space
from nerfloom.splats.drawing import splat_camera
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.guide import GUIDE, FoundDistances
from nerfloom.splats.learning import open_degree
from nerfloom.splats.resolution import enlarged, reduced, reduced_distances, reduced_weights
from nerfloom.splats.settings import SplattingConfig, decide_splatting
from nerfloom.splats.start import PLACES, first_points, from_points, on_surfaces, scene_size, seen_colors
from nerfloom.training.optim import learning_rate_factor

NOISE, OPACITY_PENALTY, SCALE_PENALTY = 5e5, 0.002, 0.01
"""Noise and penalties unless Gaussians start on surfaces. They are the values of Kheradmand et al. 2024 except the
opacity penalty: theirs left too few Gaussians after a few hundred steps at a higher learning rate."""
FIELD_SHARE, CLOSED_FIELD_SHARE = 0.2, 0.4
"""Maximum share of --max-seconds for training the field that Gaussians start from, and where every ray ends in the
box."""


@dataclass(frozen=True)
class GaussianSplattingConfig(SplattingConfig):
    """Settings of gaussian-splatting."""

    RANGES: ClassVar[dict[str, Range]] = {
        "camera_learning_rate": AT_LEAST_0,
        "depth_loss_mult": AT_LEAST_0,
        "field_depth_mult": AT_LEAST_0,
        "ssim_weight": (0, 1),
    }
    ssim_weight: float = 0.2
    """Weight of 1 - SSIM in the loss; the absolute error has the weight 1 - ssim_weight."""
    camera_optimizer: Auto[Literal["off", "SO3xR3", "SE3"]] = AUTO
    """Refinement of the training cameras' poses; auto: SO3xR3 if a device tracked them, else off."""
    camera_learning_rate: float = 1e-3
    """Initial learning rate of the poses, before --rate-factor."""
    depth_loss_mult: Auto[float] = AUTO
    """Weight of the depth loss. Default: 0.1 with depth images, else 0."""
    field_depth_mult: Auto[float] = AUTO
    """Initial weight of the starting field's distances; it falls to 0 at half of the budget. Default: 0.1 if unbounded,
    else 0."""


GaussianSplattingConfigT = TypeVar("GaussianSplattingConfigT", bound=GaussianSplattingConfig)


def decide(config: GaussianSplattingConfigT, scene: Scene) -> tuple[GaussianSplattingConfigT, list[Decision]]:
    """Fill in the settings that depend on the budget and the scene."""
    config, made = decide_splatting(config, scene)
    poses = "SO3xR3" if scene.poses == "device" else "off"
    config, more = fill(
        config,
        Choice("depth_loss_mult", 0.1 if scene.has_depth else 0.0, DEPTH_REASONS[scene.has_depth], "depth loss"),
        Choice("field_depth_mult", *GUIDE[scene.unbounded], "weight of a field's distances"),
        Choice("camera_optimizer", poses, POSE_REASONS[scene.poses], "pose refinement"),
    )
    return config, made + more


def starting_field(config: GaussianSplattingConfig, scene: Scene) -> Method:
    """Return the method of the field that Gaussians start from: nerfacto in unbounded scenes, else instant-ngp.

    Nerfacto refines the poses in the same way as the Gaussians, or not at all. Instant-ngp cannot: its samples carry no
    gradient to rays.
    """
    if not scene.unbounded:
        return load_method("instant-ngp")
    method = load_method("nerfacto")
    settings: Any = method.config
    return replace(method, config=replace(settings, camera_optimizer=config.camera_optimizer))


class GaussianSplatting(GaussianModel[GaussianSplattingConfig]):
    """A model of Gaussians drawn as whole images."""

    found: Tensor
    """Whether Gaussians started on the surfaces of a field."""

    def __init__(self, config: GaussianSplattingConfig, scene: Scene) -> None:
        super().__init__(config, scene)
        self.register_buffer("found", torch.tensor(False))
        self._found, self.found_distances = HostValue(), FoundDistances()
        self.progress = 0.0
        self.poses: PoseRefinement | None = None
        if config.camera_optimizer in ("SO3xR3", "SE3"):
            self.poses = PoseRefinement(scene.num_cameras, config.camera_optimizer, scene.camera_to_worlds)
            # A step shows one camera. Dense Adam would keep turning it for tens of steps, by 5 to 10 rates in all.
            rate = config.rate_factor * config.camera_learning_rate
            self.poses.optimised = Optimised("poses", rate, schedule="exponential", sparse=True)

    @torch.no_grad()
    def start(self, dataset: Dataset) -> None:
        """Set the first Gaussians."""
        kind, count = self.config.start, self.config.start_gaussians
        if kind == "auto":
            kind = "points" if dataset.points is not None else self.start_without_points()
        if kind == "field":
            with torch.enable_grad():
                share = CLOSED_FIELD_SHARE if self.scene.ends_in_box else FIELD_SHARE
                seconds = share * (self.config.max_seconds or math.inf)
                field = starting_field(self.config, dataset.scene)
                found = found_surfaces(field, dataset, self.config, self.config.field_steps, seconds, count)
            self.found_distances.set(found.images, found.pixels, found.distances)
            kept = ~self.in_the_way(found.positions)
            first = on_surfaces(found.positions[kept], found.colors[kept], self.config.degree)
            if not len(first):
                say("warning: the field has no surfaces; Gaussians start anywhere in the box")
                kind = "random"
            elif self.poses is not None and found.motions is not None:
                self.poses.tangents.copy_(found.motions)  # the surfaces are where the moved cameras see them
        if kind != "field":
            points = first_points(kind, dataset, count)
            first = from_points(points, seen_colors(points, dataset), self.config.degree)
        self.extent.fill_(scene_size(self.scene, first.means, dataset.cameras))
        self.set_gaussians(first)
        self.found.fill_(kind == "field")
        say(f"  {len(first):,} Gaussians start {PLACES[kind]}")

    def start_without_points(self) -> Literal["field", "silhouettes", "random"]:
        """Return where Gaussians start by default if the data has no points of a reconstruction."""
        return "field"

    def before_step(self, step: int, progress: float) -> None:
        super().before_step(step, progress)
        self.progress = progress

    def loss(self, batch: ViewBatch, step: int) -> Loss:
        config = self.config
        seen, poses, index = batch.view.camera, self.poses, batch.index
        pose = None if poses is None or index is None else poses.pose(index, seen.camera_to_worlds[0])
        octaves = self.sizes.next(self.progress)
        camera, target = splat_camera(seen, self.near, self.look(), pose, 1 << octaves), reduced(batch.rgb, octaves)
        gaussians = self.seen_gaussians(batch.view, camera)
        shown = self.on_image(gaussians, camera, min(open_degree(self.progress), config.degree))
        known, trust = self.found_distances.known(batch, self.progress, config.depth_loss_mult, config.field_depth_mult)
        content = CHANNELS["rgb" if known is None and not self.aligns_normals(self.progress) else "distance"]
        behind = self._behind(batch)
        drawn = self.rasteriser.draw(shown, camera, behind, content, self.capacity)
        rgb = drawn.image if content == CHANNELS["rgb"] else drawn.image[..., :3]
        rgb = self.lit(rgb, drawn.transmittance, behind, batch.index)
        weights = None if batch.weights is None else reduced_weights(batch.weights, octaves)
        terms = {"rgb": photometric_loss(rgb, target, config.ssim_weight, weights)}
        if self.light is not None:
            terms["appearance"] = self.light.penalty()
        if known is not None:
            known = reduced_distances(known, octaves)
            terms["depth"] = trust * mean_depth_error(drawn.image[..., 3], drawn.transmittance, known)
        if (weight := self._chosen(config.opacity_penalty, OPACITY_PENALTY)) > 0 and len(gaussians):
            terms["opacity"] = self.share_seen * weight * self.penalised_opacities(gaussians, batch.view.time).mean()
        if (weight := self._chosen(config.scale_penalty, SCALE_PENALTY)) > 0 and len(gaussians):
            terms["scale"] = self.share_seen * weight / self.extent * gaussians.log_scales.exp().mean()
        kept = None if weights is None else weights == 1
        terms |= self.surface_terms(gaussians, shown, camera, drawn, kept, self.progress)
        return Loss(terms, enlarged(rgb.detach(), batch.rgb, octaves))

    def penalised_opacities(self, gaussians: Gaussians, time: float | None) -> Tensor:
        """Return the opacities (N,); their mean is the opacity penalty.

        Args:
            gaussians: N Gaussians at a time, with gradient.
            time: in [0, 1]; None for a still scene.
        """
        return torch.sigmoid(gaussians.logits)

    def _behind(self, batch: ViewBatch) -> Tensor:
        """Return the background (3,) of a step. For images without alpha it is random, so that Gaussians cannot rely on
        it."""
        if self.scene.has_alpha or self.config.background != "auto":
            return batch.background
        return torch.rand(3, device=batch.rgb.device)

    @torch.no_grad()
    def after_every_step(self, step: int, progress: float, finite: bool | Tensor) -> None:
        super().after_every_step(step, progress, finite)
        if (noise := self._chosen(self.config.noise, NOISE)) > 0:
            rate = self.position_rate * learning_rate_factor(self.config, step, progress)
            self.shake(noise * rate * finite if isinstance(finite, Tensor) else noise * rate)

    def _chosen(self, given: float | None, otherwise: float) -> float:
        """Return `given` if it is set, 0 if Gaussians started on surfaces in a box that cameras see from outside, else
        `otherwise`. The field's distant surfaces are not reliable in unbounded scenes, nor those around cameras."""
        on_surfaces = self._found.of(self.found) and not (self.scene.unbounded or self.scene.ends_in_box)
        return given if given is not None else 0.0 if on_surfaces else otherwise

    def in_the_way(self, means: Tensor) -> Tensor:
        """Return which Gaussians (N,) bool are right before a camera, if a field has shown how near things are.

        Only in a scene where every ray ends in the box, with cameras among the things that they show.
        """
        poses, found = self.scene.camera_to_worlds, self.found_distances
        if poses is None or not self.scene.ends_in_box:
            return super().in_the_way(means)
        return in_clear_space(means, poses.to(means), clear_radii(found.images, found.distances, len(poses)).to(means))

    def refined_poses(self, poses: Tensor, training: bool) -> Tensor:
        return poses if self.poses is None else self.poses.refined(poses, training)


METHOD = Method(GaussianSplattingConfig(), paper="arXiv:2308.04079", model=GaussianSplatting, decide=decide)
