"""3D Gaussian Splatting: a scene of coloured Gaussians, drawn in real time.

Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering", SIGGRAPH 2023. Gaussians are moved to
where they are needed as in Kheradmand et al., "3D Gaussian Splatting as Markov Chain Monte Carlo", NeurIPS 2024.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal, cast

import torch
from torch import Tensor, nn

from framework import Decision, Loss, Method, Model, Optimised, Picture, RowChange, Scene, TrainConfig, View, ViewBatch
from framework.base.config import AT_LEAST_0, Range
from framework.base.console import say, track
from framework.base.decisions import Choice, fill
from framework.base.errors import ConfigError
from framework.data.dataset import Dataset
from framework.kernels.ssim import ssim
from framework.scene.silhouettes import Silhouettes, visual_hull
from framework.splats.drawing import draw, draw_view, splat_camera
from framework.splats.gaussians import MAX_DEGREE, Gaussians
from framework.splats.mcmc import moved, shaken
from framework.splats.start import from_points, hull_points, seen_colors
from framework.training.optim import learning_rate_factor

STEPS_PER_SECOND = 25
"""Training steps a second, about, of 400 x 400 pixels on two cores; for what is decided by the budget."""
NOISE, PENALTY = 5e5, 0.01
"""Noise and both penalties (Kheradmand et al. 2024), where Gaussians have to find their places."""
WITHOUT_IMAGES = 1_000
"""Maximum number of Gaussians of a model that has seen no images yet."""
HULL_CELLS = 128
"""Cells of the visual hull along an axis."""
SMALLEST_SSIM = 11
"""Pixels of an image's shorter side from which it has an SSIM."""
FIELD_OPACITY, FIELD_SIZE = 0.5, 0.7
"""Of Gaussians on a field's surfaces at the start: opacity, and standard deviation in distances to neighbours."""


@dataclass(frozen=True)
class GaussianSplattingConfig(
    TrainConfig, max_num_iterations=30_000, learning_rate=5e-3, lr_final=0.1, adam_beta2=0.99, adam_eps=1e-15
):
    """Settings of gaussian-splatting."""

    RANGES: ClassVar[dict[str, Range]] = {
        "num_gaussians": (1, 10_000_000),
        "start_gaussians": (1, 10_000_000),
        "field_steps": (1, math.inf),
        "rate_factor": AT_LEAST_0,
        "position_rate": AT_LEAST_0,
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
    """Maximum number of Gaussians; by the budget if not given."""
    start: Literal["auto", "points", "field", "silhouettes", "random"] = "auto"
    """Where Gaussians start: at the points of a reconstruction, on surfaces that a short run of instant-ngp finds, in
    the visual hull of the images' silhouettes, or anywhere in the box. auto: the first of points and field that there
    is."""
    start_gaussians: int | None = None
    """Gaussians at the start, except at the points of a reconstruction; two thirds of the maximum if not given."""
    field_steps: int | None = None
    """Training steps of that field; by the budget if not given."""
    rate_factor: float | None = None
    """Factor of all learning rates; by the budget if not given, as fewer steps have to go farther."""
    position_rate: float = 8e-5
    """Learning rate of centres before that factor, per scene extent (the cameras' largest distance from their mean)."""
    degree: int = 3
    """Highest degree of the spherical harmonics that colours are made of."""
    ssim_weight: float = 0.2
    """Weight of 1 - SSIM in the loss; the absolute error has the rest."""
    antialiased: bool = False
    """Compensate the minimum width of a Gaussian on an image by its opacity (Mip-Splatting)."""
    growth_end: float = 0.8
    """Share of the budget after which no Gaussian is added or moved."""
    steps_per_move: int = 100
    """Steps between two moves of Gaussians that have become transparent."""
    noise: float | None = None
    """Noise of nearly transparent Gaussians, times the learning rate of centres; by the start if not given."""
    opacity_penalty: float | None = None
    """Weight of the mean opacity in the loss; by the start if not given."""
    scale_penalty: float | None = None
    """Weight of the mean scale, in scene extents, in the loss; by the start if not given."""
    reduced_until: float = 0.0
    """Share of the budget in which images are half as wide and high."""


def decide(config: GaussianSplattingConfig, scene: Scene) -> tuple[GaussianSplattingConfig, list[Decision]]:
    """Return the settings with what the budget decides, and why.

    Args:
        config: settings, some of which may be open.
        scene: facts about the data.
    """
    seconds = min(config.max_seconds or math.inf, config.max_num_iterations / STEPS_PER_SECOND)
    count = int(min(max(8_000 * math.sqrt(seconds), 20_000), 1_000_000))
    factor = min(max((30_000 / (STEPS_PER_SECOND * seconds)) ** 0.44, 1.0), 5.0)
    why = "that suits the time"
    config, made = fill(config, Choice("num_gaussians", count, why, "Gaussians", f"up to {count:,}"))
    assert config.num_gaussians is not None
    first = max(config.num_gaussians * 2 // 3, 1)
    config, more = fill(
        config,
        Choice("start_gaussians", first, "the others are added", "Gaussians at the start", f"{first:,}"),
        Choice("field_steps", int(min(max(2 * seconds, 120), 400)), why, "steps of a field to start from"),
        Choice("rate_factor", round(factor, 2), "fewer steps have to go farther", "factor of learning rates"),
    )
    return config, made + more


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
    """Gaussians that are drawn onto whole images.

    Args:
        config: the settings, decided.
        scene: facts about the data.
    """

    batches: ClassVar[Literal["pixels", "views"]] = "views"
    found: Tensor
    """Whether the first Gaussians lay on surfaces, so that none has to look for its place."""

    def __init__(self, config: GaussianSplattingConfig, scene: Scene) -> None:
        super().__init__(config, scene)
        higher, factor = (config.degree + 1) ** 2 - 1, config.rate_factor
        assert factor is not None
        rate = factor * config.learning_rate

        def table(width: int, name: str, times: float, schedule: Literal["constant"] | None = "constant") -> _Table:
            return _Table(width, Optimised(name, times * rate, schedule=schedule, sparse=True))

        self.extent = _extent(scene)
        self.position_rate = factor * config.position_rate * self.extent
        self.means = table(3, "means", self.position_rate / rate, None)
        self.log_scales = table(3, "scales", 1.0)
        self.rotations = table(4, "rotations", 0.2)
        self.logits = table(1, "opacities", 10.0)
        self.colors = table(3, "colors", 0.5)
        self.harmonics = table(3 * higher, "harmonics", 0.025)
        self.register_buffer("found", torch.tensor(False))
        self.progress = 0.0
        assert config.start_gaussians is not None
        box = scene.box
        anywhere = box[0] + torch.rand(min(config.start_gaussians, WITHOUT_IMAGES), 3) * (box[1] - box[0])
        self._set(from_points(anywhere, torch.full_like(anywhere, 0.5), config.degree))

    @property
    def runs_on_kernels(self) -> bool:
        return True

    @property
    def uses_bfloat16(self) -> bool:
        return False  # there is no network

    def _chosen(self, given: float | None, otherwise: float) -> float:
        """Return a setting that is by the start if not given: Gaussians on surfaces need no search for places."""
        return given if given is not None else (0.0 if bool(self.found) else otherwise)

    def parameters_of_gaussians(self) -> list[nn.Parameter]:
        """Return the six tables."""
        tables = (self.means, self.log_scales, self.rotations, self.logits, self.colors, self.harmonics)
        return [table.values for table in tables]

    def _all(self) -> Gaussians:
        means, log_scales, rotations, logits, colors, harmonics = self.parameters_of_gaussians()
        return Gaussians(
            means, log_scales, rotations, logits[:, 0], colors, harmonics.view(len(means), 3, harmonics.shape[1] // 3)
        )

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
        kind = self.config.start
        if kind == "auto":
            kind = "field" if dataset.points is None else "points"
        if kind == "field":
            with torch.enable_grad():
                points, colors = _surfaces(self.config, dataset)
            first = from_points(points, colors, self.config.degree, FIELD_OPACITY, FIELD_SIZE)
            if not len(points):
                say("warning: the field has found no surfaces")
                kind = "random"
        if kind != "field":
            points = self._first_points(kind, dataset)
            first = from_points(points, seen_colors(points, dataset), self.config.degree)
        self._set(first)
        self.found.fill_(kind == "field")
        where = {"points": "at the points of a reconstruction", "field": "on the surfaces of a field"}
        where |= {"silhouettes": "in the visual hull", "random": "anywhere in the box"}
        say(f"  {len(first):,} Gaussians start {where[kind]}")

    def _set(self, gaussians: Gaussians) -> None:
        for parameter, values in zip(self.parameters_of_gaussians(), vars(gaussians).values(), strict=True):
            parameter.data = values.reshape(len(gaussians), parameter.shape[1]).contiguous()

    def set_gaussians(self, gaussians: Gaussians) -> None:
        """Replace them.

        Args:
            gaussians: the new ones, with harmonics of the settings' degree.
        """
        self._set(gaussians)

    def _first_points(self, kind: str, dataset: Dataset) -> Tensor:
        count, box = self.config.start_gaussians, self.scene.box.to(self.device)
        assert count is not None
        if kind == "points":
            if dataset.points is None:
                raise ConfigError("--start points: the data has no points of a reconstruction; leave out --start")
            return dataset.points.to(self.device)
        if kind == "silhouettes":
            if not self.scene.has_alpha or dataset.cameras.model != "pinhole":
                raise ConfigError("--start silhouettes needs pinhole images with alpha; leave out --start")
            hull = visual_hull(Silhouettes.of(dataset), box, HULL_CELLS)
            if bool(hull.any()):
                return hull_points(hull, box, HULL_CELLS, count)
            say("warning: the images' alpha leaves no part of the box; Gaussians start anywhere in it")
        return box[0] + torch.rand(count, 3, device=self.device) * (box[1] - box[0])

    # -- training ---------------------------------------------------------------------------------------------

    def before_step(self, step: int, progress: float) -> None:
        self.progress = progress

    def loss(self, batch: ViewBatch, step: int) -> Loss:
        config = self.config
        reduced = 2 if self.progress < config.reduced_until else 1
        camera = splat_camera(batch.view.camera, self._near, config.antialiased, reduced=reduced)
        target = batch.rgb if reduced == 1 else _halved(batch.rgb)
        gaussians = self._all()
        rgb = draw(gaussians, camera, batch.background, self._degree)
        if batch.kept is not None:  # what does not count is as it should be
            kept = batch.kept if reduced == 1 else _halved(batch.kept[..., None].float())[..., 0] == 1
            target = torch.where(kept[..., None], target, rgb.detach())
        terms = {"rgb": (1 - config.ssim_weight) * (rgb - target).abs().mean()}
        if config.ssim_weight > 0 and min(rgb.shape[:2]) >= SMALLEST_SSIM:
            terms["ssim"] = config.ssim_weight * (1 - ssim(rgb, target))
        if (weight := self._chosen(config.opacity_penalty, PENALTY)) > 0:
            terms["opacity"] = weight * torch.sigmoid(gaussians.logits).mean()
        if (weight := self._chosen(config.scale_penalty, PENALTY)) > 0:
            terms["scale"] = weight / self.extent * gaussians.log_scales.exp().mean()
        shown = rgb.detach() if reduced == 1 else _doubled(rgb.detach(), batch.rgb)
        return Loss(terms, shown)

    @property
    def _degree(self) -> int:
        """Degree of harmonics that counts so far."""
        return min(int(self.progress * 2 * (MAX_DEGREE + 1)), self.config.degree)

    @torch.no_grad()
    def after_step(self, step: int, progress: float) -> Sequence[RowChange]:
        config = self.config
        if (noise := self._chosen(config.noise, NOISE)) > 0:
            rate = self.position_rate * learning_rate_factor(config, step, progress)
            which, by = shaken(self.gaussians(), noise * rate)
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

    steps, count = config.field_steps, config.start_gaussians
    assert steps is not None
    assert count is not None
    field = replace(
        load_method("instant-ngp").config,
        max_num_iterations=steps,
        vis="none",
        machine=config.machine,
        background=config.background,
    )
    trainer = Trainer(Run("instant-ngp", field, "", cast("Any", None), Path()), dataset, None)
    for _ in track(range(steps), "Looking for surfaces", total=steps):
        trainer.train_step()
    model = trainer.model.eval()
    points, colors = [torch.zeros(0, 3)], [torch.zeros(0, 3)]
    while (left := count - sum(map(len, points))) > 0 and len(points) < 16:
        found = joined(surface_points(cast("Any", model), dataset, 2 * left, None))
        points.append(found.positions[:left])
        colors.append(found.colors[:left])
    return torch.cat(points).to(dataset.device), torch.cat(colors).to(dataset.device)


def _extent(scene: Scene) -> float:
    """Return the scale of the scene: 1.1 times the largest distance of a camera from their middle."""
    if scene.camera_to_worlds is None:
        return float((scene.box[1] - scene.box[0]).norm()) / 2
    centers = scene.camera_to_worlds[:, :, 3]
    return 1.1 * float((centers - centers.mean(0)).norm(dim=-1).max()) or 1.0


def _halved(image: Tensor) -> Tensor:
    """Return an image (H, W, C) of half the size, each pixel the mean of four."""
    height, width = image.shape[0] // 2 * 2, image.shape[1] // 2 * 2
    return image[:height, :width].reshape(height // 2, 2, width // 2, 2, -1).mean((1, 3))


def _doubled(image: Tensor, whole: Tensor) -> Tensor:
    """Return an image of half the size as large as the whole one, of which it takes an odd last row or column."""
    out = whole.clone()
    out[: 2 * image.shape[0], : 2 * image.shape[1]] = image.repeat_interleave(2, 0).repeat_interleave(2, 1)
    return out


METHOD = Method(GaussianSplattingConfig(), paper="arXiv:2308.04079", model=GaussianSplatting, decide=decide)
