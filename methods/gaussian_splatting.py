"""3D Gaussian Splatting: a scene of coloured Gaussians, drawn in real time.

Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering", SIGGRAPH 2023. Gaussians grow by
gradients, or are moved as in Kheradmand et al., "3D Gaussian Splatting as Markov Chain Monte Carlo", NeurIPS 2024.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from torch import Tensor

from nerfloom import Cameras, Decision, GaussianModel, Loss, Method, Optimised, Scene, ViewBatch
from nerfloom.base.config import AT_LEAST_0, AUTO, Auto, Range
from nerfloom.base.console import say
from nerfloom.base.decisions import Choice, fill
from nerfloom.base.device import HostValue
from nerfloom.cameras.refinement import PoseRefinement
from nerfloom.data.dataset import Dataset
from nerfloom.export.surfaces import found_surfaces
from nerfloom.fields.appearance import AFFINE, Appearance, affine_colors
from nerfloom.kernels.images.ssim import photometric_loss
from nerfloom.kernels.splats.blend import CHANNELS
from nerfloom.kernels.splats.project import SplatCamera
from nerfloom.losses.functions import mean_depth_error
from nerfloom.registry import load_method
from nerfloom.scene.reasons import DEPTH_REASONS, LIGHT_REASONS, POSE_REASONS
from nerfloom.splats.drawing import splat_camera
from nerfloom.splats.guide import GUIDE, FoundDistances
from nerfloom.splats.learning import open_degree
from nerfloom.splats.resolution import enlarged, reduced, reduced_distances
from nerfloom.splats.settings import SplattingConfig, decide_splatting
from nerfloom.splats.start import PLACES, first_points, from_points, scene_size, seen_colors
from nerfloom.training.optim import learning_rate_factor

NOISE, OPACITY_PENALTY, SCALE_PENALTY = 5e5, 0.002, 0.01
"""Noise and penalties where Gaussians have to find their places: those of Kheradmand et al. 2024, but for the first
penalty, which at a few hundred steps of a higher rate left too few of them."""
FIELD_SHARE = 0.2
"""Maximum share of a budget in seconds that the training of a field to start from takes."""
FIELD_OPACITY, FIELD_SIZE = 0.5, 0.7
"""Of Gaussians on a field's surfaces at the start: opacity, and standard deviation in distances to neighbours."""


@dataclass(frozen=True)
class GaussianSplattingConfig(SplattingConfig):
    """Settings of gaussian-splatting."""

    RANGES: ClassVar[dict[str, Range]] = {
        "appearance_rate": AT_LEAST_0,
        "camera_learning_rate": AT_LEAST_0,
        "depth_loss_mult": AT_LEAST_0,
        "field_depth_mult": AT_LEAST_0,
        "ssim_weight": (0, 1),
    }
    """Allowed range of each numeric setting."""
    ssim_weight: float = 0.2
    """Weight of 1 - SSIM in the loss; the absolute error has the rest."""
    appearance: Auto[bool] = AUTO
    """Whether each training image has a transform of colours of its own. If not given: if light or exposure differ."""
    appearance_rate: float = 1e-3
    """Learning rate of these transforms."""
    camera_optimizer: Auto[Literal["off", "SO3xR3", "SE3"]] = AUTO
    """Refinement of the training cameras' poses; auto: SO3xR3 if a device tracked them, else off."""
    camera_learning_rate: float = 1e-3
    """Initial learning rate of the poses."""
    depth_loss_mult: Auto[float] = AUTO
    """Weight of the depth loss. If not given: 0.1 if there are depth images, else 0."""
    field_depth_mult: Auto[float] = AUTO
    """Weight of a starting field's distances until half of the budget. If not given: 0.1 if unbounded, else 0."""


def decide(config: GaussianSplattingConfig, scene: Scene) -> tuple[GaussianSplattingConfig, list[Decision]]:
    """Return the settings with what the budget and the scene decide, and why.

    Args:
        config: settings, some of which may be open.
        scene: facts about the data.
    """
    config, made = decide_splatting(config, scene)
    varies, poses = scene.appearance_varies, "SO3xR3" if scene.poses == "device" else "off"
    config, more = fill(
        config,
        Choice("appearance", varies, LIGHT_REASONS[varies], "colour transforms of images"),
        Choice("depth_loss_mult", 0.1 if scene.has_depth else 0.0, DEPTH_REASONS[scene.has_depth], "depth loss"),
        Choice("field_depth_mult", *GUIDE[scene.unbounded], "weight of a field's distances"),
        Choice("camera_optimizer", poses, POSE_REASONS[scene.poses], "pose refinement"),
    )
    return config, made + more


class GaussianSplatting(GaussianModel[GaussianSplattingConfig]):
    """Gaussians that are drawn onto whole images.

    Args:
        config: the settings, decided.
        scene: facts about the data.
    """

    found: Tensor
    """Whether the first Gaussians lay on surfaces, so that none has to look for its place."""

    def __init__(self, config: GaussianSplattingConfig, scene: Scene) -> None:
        super().__init__(config, scene)
        self.register_buffer("found", torch.tensor(False))
        self._found, self.found_distances = HostValue(), FoundDistances()
        self.progress = 0.0
        self.appearance: Appearance | None = None
        if config.appearance:
            optimised, share = Optimised("appearance", config.appearance_rate), config.mean_appearance_share
            self.appearance = Appearance(AFFINE, scene.num_cameras, optimised, share, config.eval_appearance)
        self.poses: PoseRefinement | None = None
        if config.camera_optimizer in ("SO3xR3", "SE3"):
            self.poses = PoseRefinement(scene.num_cameras, config.camera_optimizer, scene.camera_to_worlds)
            self.poses.optimised = Optimised("poses", config.camera_learning_rate, schedule="exponential")

    @torch.no_grad()
    def start(self, dataset: Dataset) -> None:
        """Set the first Gaussians.

        Args:
            dataset: images to learn from.
        """
        kind, count = self.config.start, self.config.start_gaussians
        if kind == "auto":
            kind = "field" if dataset.points is None else "points"
        if kind == "field":
            with torch.enable_grad():
                seconds = FIELD_SHARE * (self.config.max_seconds or math.inf)
                field = load_method("nerfacto" if dataset.scene.unbounded else "instant-ngp")
                found = found_surfaces(field, dataset, self.config, self.config.field_steps, seconds, count)
            first = from_points(found.positions, found.colors, self.config.degree, FIELD_OPACITY, FIELD_SIZE)
            self.found_distances.set(found.images, found.pixels, found.distances)
            if not len(first):
                say("warning: the field has found no surfaces")
                kind = "random"
        if kind != "field":
            points = first_points(kind, dataset, count)
            first = from_points(points, seen_colors(points, dataset), self.config.degree)
        self.extent.fill_(scene_size(self.scene, first.means, dataset.cameras))
        self.set_gaussians(first)
        self.found.fill_(kind == "field")
        say(f"  {len(first):,} Gaussians start {PLACES[kind]}")

    def before_step(self, step: int, progress: float) -> None:
        super().before_step(step, progress)
        self.progress = progress

    def loss(self, batch: ViewBatch, step: int) -> Loss:
        config = self.config
        seen, poses = batch.view.camera, self.poses
        pose = None if poses is None else poses.pose(batch.index, seen.camera_to_worlds[0])
        octaves = self.sizes.next(self.progress)
        camera, target = splat_camera(seen, self.near, self.look(), pose, 1 << octaves), reduced(batch.rgb, octaves)
        gaussians = self.learnt_gaussians(batch.view.time)
        shown = self.on_image(gaussians, camera, min(open_degree(self.progress), config.degree))
        known, trust = self.found_distances.known(batch, self.progress, config.depth_loss_mult, config.field_depth_mult)
        content = CHANNELS["rgb" if known is None else "distance"]
        drawn = self.rasteriser.draw(shown, camera, self._behind(batch), content, self.capacity)
        rgb = self.lit(drawn.image if known is None else drawn.image[..., :3], batch.index)
        if batch.kept is not None:  # what does not count is as it should be
            kept = reduced(batch.kept[..., None].float(), octaves)[..., 0] == 1
            target = torch.where(kept[..., None], target, rgb.detach())
        terms = {"rgb": photometric_loss(rgb, target, config.ssim_weight)}
        if known is not None:
            known = reduced_distances(known, octaves)
            terms["depth"] = trust * mean_depth_error(drawn.image[..., 3], drawn.transmittance, known)
        if (weight := self._chosen(config.opacity_penalty, OPACITY_PENALTY)) > 0 and len(gaussians):
            terms["opacity"] = weight * torch.sigmoid(gaussians.logits).mean()
        if (weight := self._chosen(config.scale_penalty, SCALE_PENALTY)) > 0 and len(gaussians):
            terms["scale"] = weight / self.extent * gaussians.log_scales.exp().mean()
        return Loss(terms, enlarged(rgb.detach(), batch.rgb, octaves))

    def _behind(self, batch: ViewBatch) -> Tensor:
        """Return the background (3,) of a step. Images without alpha show something everywhere: a background that
        changes with each step cannot be a part of it."""
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
        """Return a setting that is by the start if not given: Gaussians on surfaces need no search for places, but for
        those far away, where a field that was trained for seconds is mist."""
        on_surfaces = self._found.of(self.found) and not self.scene.unbounded
        return given if given is not None else 0.0 if on_surfaces else otherwise

    def lit(self, rgb: Tensor, index: int | None) -> Tensor:
        """Return colours (..., 3) as an image shows them: a training image, or one with the appearance that is set."""
        if self.appearance is None:
            return rgb
        which = None if index is None else torch.arange(index, index + 1, device=rgb.device)
        return affine_colors(rgb, self.appearance(which, 1)[0])

    def camera(self, camera: Cameras) -> SplatCamera:
        """Return the camera of a view that is not trained on, moved as the training cameras around it were."""
        pose = None if self.poses is None else self.poses.carried_pose(camera.camera_to_worlds[0])
        return splat_camera(camera, self.near, self.look(), pose)

    def refined_cameras(self, cameras: Cameras) -> Cameras:
        """Return the training cameras with refined poses.

        Args:
            cameras: M training cameras with the poses of the data.
        """
        return cameras if self.poses is None else self.poses.refined(cameras)


METHOD = Method(GaussianSplattingConfig(), paper="arXiv:2308.04079", model=GaussianSplatting, decide=decide)
