"""3D Gaussian Splatting: a scene of coloured Gaussians, drawn in real time.

Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering", SIGGRAPH 2023. Gaussians are moved to
where they are needed as in Kheradmand et al., "3D Gaussian Splatting as Markov Chain Monte Carlo", NeurIPS 2024.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal, cast

import torch
from torch import Tensor, nn

from framework import Decision, Loss, Method, Model, Optimised, Picture, RowChange, Scene, TrainConfig, View, ViewBatch
from framework.base.config import AT_LEAST_0, Range
from framework.base.console import say
from framework.base.decisions import Choice, fill
from framework.data.dataset import Dataset
from framework.kernels.ssim import ssim
from framework.scene.silhouettes import Silhouettes, visual_hull
from framework.splats.drawing import draw, draw_view, splat_camera
from framework.splats.gaussians import MAX_DEGREE, Gaussians
from framework.splats.mcmc import moved, shaken
from framework.splats.start import from_points, hull_points, seen_colors

HULL_CELLS = 128
"""Cells of the visual hull along an axis."""
FIELD_STEPS = 120
"""The least steps of the field on whose surfaces Gaussians start: a busy machine may take few in the time."""
FIELD_OPACITY, FIELD_SIZE = 0.5, 0.7
"""Of Gaussians on a field's surfaces at the start: opacity, and standard deviation in distances to neighbours."""


@dataclass(frozen=True)
class GaussianSplattingConfig(
    TrainConfig, max_num_iterations=30_000, learning_rate=5e-3, lr_schedule="exponential", lr_final=0.1, adam_eps=1e-15
):
    """Settings of gaussian-splatting."""

    RANGES: ClassVar[dict[str, Range]] = {
        "num_gaussians": (1, 10_000_000),
        "start_gaussians": (1, 10_000_000),
        "degree": (0, MAX_DEGREE),
        "ssim_weight": (0, 1),
        "growth_end": (0, 1),
        "steps_per_move": (1, 10**9),
        "noise": AT_LEAST_0,
        "opacity_penalty": AT_LEAST_0,
        "scale_penalty": AT_LEAST_0,
        "reduced_until": (0, 1),
    }
    """Allowed range of each numeric setting."""
    num_gaussians: int | None = None
    """The most Gaussians; by the time there is if not given."""
    start_gaussians: int | None = None
    """Gaussians at the start, where they do not start at the points of a reconstruction."""
    start: Literal["auto", "points", "field", "silhouettes", "random"] = "auto"
    """Where they start: at the points of a reconstruction, on surfaces that a short run of instant-ngp finds, along the
    silhouettes' hull, or anywhere in the box."""
    field_seconds: float | None = None
    """Seconds for which instant-ngp is trained first, where Gaussians start on its surfaces."""
    degree: int = 3
    """Highest degree of the spherical harmonics that colours are made of."""
    ssim_weight: float = 0.2
    """Share of 1 - SSIM in the loss; the rest is the absolute error."""
    antialiased: bool = False
    """Make up for the width that each Gaussian has at least on an image by its opacity (Mip-Splatting)."""
    growth_end: float = 0.8
    """Share of the budget after which no Gaussian is added or moved."""
    steps_per_move: int = 100
    """Steps between two moves of Gaussians that have become transparent."""
    noise: float = 5e5
    """Noise of nearly transparent Gaussians, times the learning rate of centres."""
    opacity_penalty: float = 0.01
    """Weight of the mean opacity in the loss."""
    scale_penalty: float = 0.01
    """Weight of the mean scale in the loss."""
    reduced_until: float = 0.25
    """Share of the budget in which images are half as wide and high."""
    position_rate: float = 1.6e-4
    """Learning rate of centres, in times the cameras' mean distance from the scene's middle."""


def decide(config: GaussianSplattingConfig, scene: Scene) -> tuple[GaussianSplattingConfig, list[Decision]]:
    """Return the settings with what the scene and the budget decide, and why.

    Args:
        config: settings, some of which may be open.
        scene: facts about the data.
    """
    seconds = config.max_seconds
    count = 1_000_000 if seconds is None else int(min(max(1_000 * seconds, 20_000), 200_000))
    return fill(
        config,
        Choice("num_gaussians", count, "that suits the time", "Gaussians", f"up to {count:,}"),
        Choice("field_seconds", 5.0 if seconds is None else min(max(0.1 * seconds, 3.0), 15.0), "a tenth of the time"),
        Choice("start_gaussians", count // 4, "a quarter of them", "Gaussians at the start", f"{count // 4:,}"),
    )


class _Table(nn.Module):
    """One parameter of every Gaussian, with its learning rate."""

    def __init__(self, width: int, optimised: Optimised) -> None:
        super().__init__()
        self.values = nn.Parameter(torch.zeros(0, width))
        self.optimised = optimised

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *rest: object) -> None:
        saved = state_dict.get(prefix + "values")
        if saved is not None and saved.ndim == 2 and saved.shape[1] == self.values.shape[1]:
            self.values.data = self.values.new_zeros(saved.shape)
        super()._load_from_state_dict(state_dict, prefix, *rest)


class GaussianSplatting(Model[GaussianSplattingConfig]):
    """Gaussians that are drawn onto whole images."""

    batches: ClassVar[Literal["pixels", "views"]] = "views"

    def __init__(self, config: GaussianSplattingConfig, scene: Scene) -> None:
        super().__init__(config, scene)
        rate, higher = config.learning_rate, (config.degree + 1) ** 2 - 1

        def table(width: int, name: str, times: float, schedule: Literal["constant"] | None = "constant") -> _Table:
            return _Table(width, Optimised(name, times * rate, schedule=schedule, sparse=True))

        self.extent = _extent(scene)
        self.means = table(3, "means", config.position_rate / rate * self.extent, None)
        self.log_scales = table(3, "scales", 1.0)
        self.rotations = table(4, "rotations", 0.2)
        self.logits = table(1, "opacities", 10.0)
        self.colors = table(3, "colors", 0.5)
        self.harmonics = table(3 * higher, "harmonics", 0.025)
        self.progress = 0.0

    @property
    def runs_on_kernels(self) -> bool:
        return True

    @property
    def uses_bfloat16(self) -> bool:
        return False  # there is no network

    def parameters_of_gaussians(self) -> list[nn.Parameter]:
        """Return the six tables."""
        tables = (self.means, self.log_scales, self.rotations, self.logits, self.colors, self.harmonics)
        return [table.values for table in tables]

    def _all(self) -> Gaussians:
        means, log_scales, rotations, logits, colors, harmonics = self.parameters_of_gaussians()
        return Gaussians(means, log_scales, rotations, logits[:, 0], colors, harmonics.view(len(means), 3, -1))

    def gaussians(self) -> Gaussians:
        """Return them, without gradient."""
        return self._all().map(Tensor.detach)

    # -- the start --------------------------------------------------------------------------------------------

    @torch.no_grad()
    def start(self, dataset: Dataset) -> None:
        """Set the first Gaussians.

        Args:
            dataset: images to learn from.
        """
        if self.config.start == "field":
            with torch.enable_grad():
                points, colors = _surfaces(self.config, dataset)
            self._set(from_points(points, colors, self.config.degree, FIELD_OPACITY, FIELD_SIZE))
            how = "on a field's surfaces"
        else:
            points, how = self._first_points(dataset)
            self._set(from_points(points, seen_colors(points, dataset), self.config.degree))
        say(f"  {len(points):,} Gaussians start {how}")

    def _first_points(self, dataset: Dataset) -> tuple[Tensor, str]:
        start, count, scene = self.config.start, self.config.start_gaussians, self.scene
        assert count is not None
        if start in ("auto", "points") and dataset.points is not None:
            return dataset.points.to(self.device), "at the reconstruction's points"
        if start in ("auto", "silhouettes") and scene.has_alpha and dataset.cameras.model == "pinhole":
            box = scene.box.to(self.device)
            hull = visual_hull(Silhouettes.of(dataset), box, HULL_CELLS)
            if bool(hull.any()):
                return hull_points(hull, box, HULL_CELLS, count), "along the silhouettes' hull"
        box = scene.box.to(self.device)
        return box[0] + torch.rand(count, 3, device=self.device) * (box[1] - box[0]), "anywhere in the box"

    def _set(self, gaussians: Gaussians) -> None:
        for parameter, values in zip(self.parameters_of_gaussians(), vars(gaussians).values(), strict=True):
            parameter.data = values.reshape(len(gaussians), parameter.shape[1]).contiguous()

    # -- training ---------------------------------------------------------------------------------------------

    def before_step(self, step: int, progress: float) -> None:
        self.progress = progress

    def loss(self, batch: ViewBatch, step: int) -> Loss:
        config = self.config
        reduced = 2 if self.progress < config.reduced_until else 1
        camera = splat_camera(batch.view.camera, self._near, config.antialiased, reduced=reduced)
        target = batch.rgb if reduced == 1 else _halved(batch.rgb)
        gaussians = self._all()
        rgb = draw(gaussians, camera, batch.background, self._degree).rgb
        terms = {"rgb": (1 - config.ssim_weight) * (rgb - target).abs().mean()}
        if config.ssim_weight > 0:
            terms["ssim"] = config.ssim_weight * (1 - ssim(rgb, target))
        if config.opacity_penalty > 0:
            terms["opacity"] = config.opacity_penalty * torch.sigmoid(gaussians.logits).mean()
        if config.scale_penalty > 0:
            terms["scale"] = config.scale_penalty / self.extent * gaussians.log_scales.exp().mean()
        shown = rgb.detach()
        if reduced == 2:
            shown = shown.repeat_interleave(2, 0).repeat_interleave(2, 1)
            shown = torch.nn.functional.pad(
                shown.permute(2, 0, 1)[None],
                (0, batch.rgb.shape[1] - shown.shape[1], 0, batch.rgb.shape[0] - shown.shape[0]),
                mode="replicate",
            )[0].permute(1, 2, 0)
        return Loss(terms, shown)

    @property
    def _degree(self) -> int:
        """Degree of harmonics that counts so far."""
        return min(int(self.progress * 2 * (MAX_DEGREE + 1)), self.config.degree)

    @torch.no_grad()
    def after_step(self, step: int, progress: float) -> Sequence[RowChange]:
        config = self.config
        rate = 0.01**progress * config.position_rate * self.extent
        if config.noise > 0:
            which, by = shaken(self.gaussians(), config.noise * rate)
            self.means.values.data[which] += by
        if step % config.steps_per_move != config.steps_per_move - 1 or progress > config.growth_end:
            return ()
        here = len(self.means.values)
        assert config.num_gaussians is not None
        change = moved(self.gaussians(), max(min(config.num_gaussians, int(1.05 * here)) - here, 0))
        if change is None:
            return ()
        kept, fresh = change
        rows = (values.reshape(len(fresh), -1) for values in vars(fresh).values())
        return [RowChange(p, kept, values) for p, values in zip(self.parameters_of_gaussians(), rows, strict=True)]

    # -- pictures ---------------------------------------------------------------------------------------------

    def render_view(self, view: View, background: Tensor) -> Picture:
        scene = self.scene
        return draw_view(self.gaussians(), view, background, self._near, scene.far, self.config.antialiased)

    @property
    def _near(self) -> float:
        return max(0.2 * self.scene.near, 1e-3)


def _surfaces(config: GaussianSplattingConfig, dataset: Dataset) -> tuple[Tensor, Tensor]:
    """Return points (N, 3) on the surfaces that a short run of instant-ngp finds, and their colours (N, 3)."""
    from framework.base.registry import load_method
    from framework.export.points import joined, surface_points
    from framework.training.run import Run
    from framework.training.trainer import Trainer

    seconds, count = config.field_seconds, config.start_gaussians
    assert seconds is not None and count is not None
    field = replace(
        load_method("instant-ngp").config,
        max_seconds=seconds,
        vis="none",
        machine=config.machine,
        background=config.background,
    )
    trainer = Trainer(Run("instant-ngp", field, "", cast("Any", None), Path()), dataset, None)
    while trainer.state.seconds < seconds or trainer.state.step < FIELD_STEPS:
        trainer.train_step()
    model = trainer.model.eval()
    points, colors = [torch.zeros(0, 3)], [torch.zeros(0, 3)]
    while (left := count - sum(map(len, points))) > 0 and len(points) < 16:
        found = joined(surface_points(cast("Any", model), dataset, 2 * left, None))
        points.append(found.positions[:left]), colors.append(found.colors[:left])
    return torch.cat(points).to(dataset.device), torch.cat(colors).to(dataset.device)


def _extent(scene: Scene) -> float:
    """Return the scale of the scene: 1.1 times the largest distance of a camera from their middle."""
    if scene.camera_to_worlds is None:
        return float((scene.box[1] - scene.box[0]).norm()) / 2
    centers = scene.camera_to_worlds[:, :, 3]
    return 1.1 * float((centers - centers.mean(0)).norm(dim=-1).max()) or 1.0


def _halved(image: Tensor) -> Tensor:
    """Return an image (H, W, 3) of half the size, each pixel the mean of four."""
    height, width = image.shape[0] // 2 * 2, image.shape[1] // 2 * 2
    return image[:height, :width].reshape(height // 2, 2, width // 2, 2, 3).mean((1, 3))


METHOD = Method(GaussianSplattingConfig(), paper="arXiv:2308.04079", model=GaussianSplatting, decide=decide)
