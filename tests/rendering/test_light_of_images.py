"""The light of images: closed forms, an explicit loop in float64, and known exposures that are found again."""

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from nerfloom import Scene
from nerfloom.base.config import AppearanceConfig, VectorConfig
from nerfloom.base.errors import ConfigError
from nerfloom.data.sources import Request
from nerfloom.evaluation.evaluator import evaluate
from nerfloom.fields.appearance import make_vectors
from nerfloom.kernels.color import to_linear, to_srgb
from nerfloom.rendering.bilateral_grid import luminance, sliced, sliced_image, variation
from nerfloom.rendering.light import (
    AFFINE,
    GRID,
    SQUARED,
    STOPS,
    AffineLight,
    GridLight,
    Light,
    ToneLight,
    make_light,
    transformed,
    without_background,
)
from nerfloom.rendering.tone import INTERVALS, REACH, tone_curve
from nerfloom.training.checkpoint import load_checkpoint
from nerfloom.training.trainer import Trainer
from tests.training.helpers import assert_same_bits, tensors, tiny_run, tiny_trainer

SCENE = Scene(torch.tensor([[-1.0] * 3, [1.0] * 3]), 1.0, 6.0, 4, False, False, 32)
KINDS = "affine", "tone", "grid"
MATRIX = torch.tensor([[1.2, 0.1, 0.0, 0.05], [0.0, 0.8, 0.0, -0.02], [0.1, 0.0, 0.9, 0.1]])
IDENTITY = torch.eye(4)[:3]


def light_of(kind: str, scene: Scene = SCENE, share: float = 0.0) -> Light:
    light = make_light(AppearanceConfig(appearance=kind, mean_appearance_share=share), scene)  # type: ignore[arg-type]
    assert light is not None
    return light


def srgb(linear: np.ndarray) -> np.ndarray:
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)


def linear(stored: np.ndarray) -> np.ndarray:
    return np.where(stored <= 0.04045, stored / 12.92, ((stored + 0.055) / 1.055) ** 2.4)


# -- what is chosen ---------------------------------------------------------------------------------------------------


def test_the_kind_decides_who_has_the_parameters() -> None:
    for kind, of_field in (("none", False), ("vector", True), *((kind, False) for kind in KINDS)):
        config = VectorConfig(appearance=kind, appearance_embedding_dim=5)  # type: ignore[arg-type]
        vectors = make_vectors(config, SCENE)
        assert (vectors is not None) is of_field
        assert (make_light(config, SCENE) is not None) is (kind in KINDS)
    assert vectors is None
    with pytest.raises(ConfigError, match=r"^--appearance vector: .* take affine, tone or grid$"):
        AppearanceConfig(appearance="vector")


# -- closed forms -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_before_training_nothing_changes(kind: str) -> None:
    """Rays and images, for each image and in the mean."""
    torch.manual_seed(0)
    light, behind = light_of(kind), torch.rand(3)
    rays, image = torch.rand(50, 3), torch.rand(6, 7, 3)
    for images in (None, torch.arange(50) % 4):
        found = light.lit(rays, torch.rand(50), behind, images, torch.rand(50, 2))
        torch.testing.assert_close(found, rays, atol=1e-5, rtol=0)
    for index in (None, torch.tensor([2])):
        torch.testing.assert_close(light.lit(image, torch.rand(6, 7), behind, index), image, atol=1e-5, rtol=0)
    assert float(light.penalty().detach()) == 0
    empty = light.lit(rays[:0], torch.zeros(0), behind, torch.zeros(0, dtype=torch.int64))
    assert empty.shape == (0, 3)


def test_affine_functions_change_each_sample_and_not_the_background() -> None:
    """Against the function of each of three samples before they are composited."""
    torch.manual_seed(0)
    light = light_of("affine")
    light.vectors.data[:] = 0.2 * torch.randn(4, AFFINE)
    weights, colors, background = 0.3 * torch.rand(5, 3), torch.rand(5, 3, 3), torch.rand(5, 3)
    images = torch.arange(5) % 4
    opacity = weights.sum(1)
    behind = (1 - opacity)[:, None] * background
    affine = light.vectors.detach()[images].view(5, 1, 3, 4)
    changed = colors + (affine[..., :3] * colors[:, :, None]).sum(-1) + affine[..., 3]
    shown = light.lit((weights[..., None] * colors).sum(1) + behind, opacity, background, images)
    torch.testing.assert_close(shown, (weights[..., None] * changed).sum(1) + behind)


def test_a_picture_changes_as_its_pixels_do() -> None:
    """A whole image, by one matrix product, and its pixels as rays; so in the mean light and in one that is set."""
    torch.manual_seed(0)
    for kind in ("affine", "tone"):
        light, image, opacity, behind = light_of(kind), torch.rand(4, 5, 3), torch.rand(4, 5), torch.rand(3)
        for parameter in light.parameters():
            parameter.data[:] = 0.2 * torch.randn(parameter.shape)
        flat = image.view(-1, 3), opacity.view(-1), behind
        pixels = light.lit(*flat, torch.full((20,), 3))
        torch.testing.assert_close(light.lit(image, opacity, behind, torch.tensor([3])).view(-1, 3), pixels)
        with light.shown(light.of_images()[3].detach()):
            torch.testing.assert_close(light.lit(image, opacity, behind).view(-1, 3), pixels)
        mean = light.of_images().detach().mean(0)
        plain = light.lit(image, opacity, behind)
        with light.shown(mean):
            torch.testing.assert_close(light.lit(image, opacity, behind), plain)


def test_a_stop_doubles_linear_light_and_white_balance_is_of_red_and_blue() -> None:
    light, opaque = light_of("tone"), torch.ones(40)
    light.vectors.data[1] = torch.tensor([1.0, 0.5, -0.25]) / STOPS
    colors = torch.rand(40, 3, generator=torch.Generator().manual_seed(0)) * 0.6
    shown = light.lit(colors, opaque, torch.zeros(3), torch.ones(40, dtype=torch.int64)).detach()
    expected = srgb(linear(colors.double().numpy()) * 2 ** np.array([1.5, 1.0, 0.75]))
    torch.testing.assert_close(shown.double(), torch.from_numpy(expected), atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(to_srgb(to_linear(colors)), colors, atol=1e-6, rtol=0)


def test_exposures_start_where_files_state_them_and_stay_neutral() -> None:
    stops = torch.tensor([1.0, -0.5, -0.5, 0.0])
    light = light_of("tone", dataclasses.replace(SCENE, exposures=stops))
    torch.testing.assert_close(light.of_images()[:, 0].detach() * STOPS, stops)
    assert float(light.penalty().detach()) == 0
    assert float(light.current()[0]) == pytest.approx(0, abs=1e-7)


def test_images_of_a_device_share_a_curve() -> None:
    light = light_of("tone", dataclasses.replace(SCENE, devices=torch.tensor([0, 1, 1, 0])))
    assert isinstance(light, ToneLight)
    assert light.curves.shape == (2, INTERVALS)
    light.curves.data[1] = 0.3
    grey = torch.full((4, 3), 0.5)
    shown = light.lit(grey, torch.ones(4), torch.zeros(3), torch.arange(4)).detach()[:, 0]
    assert shown.tolist() == pytest.approx([0.5, 0.5 * math.exp(0.3), 0.5 * math.exp(0.3), 0.5], rel=1e-5)
    light.lit(grey[:1], torch.ones(1), torch.zeros(3), torch.tensor([2])).sum().backward()
    assert light.curves.grad is not None
    assert not light.curves.grad[0].any()
    assert light.curves.grad[1, :4].all()  # the intervals below mid grey


def test_values_that_are_not_finite_stay_so_and_stop_nothing() -> None:
    """The step is then dropped; an index that is made of NaN would end the run."""
    for kind in KINDS:
        colors = torch.tensor([[math.nan, 0.5, 0.5], [math.inf, 0.5, 0.5], [0.5, 0.5, 0.5]])
        shown = light_of(kind).lit(colors, torch.ones(3), torch.zeros(3), torch.arange(3))
        assert not shown[0].isfinite().all()
        assert shown[2].isfinite().all()


# -- tone curves ------------------------------------------------------------------------------------------------------


def test_curves_are_monotone_and_the_integral_of_their_slopes() -> None:
    draws = torch.Generator().manual_seed(0)
    log_slopes = torch.randn(3, INTERVALS, generator=draws, dtype=torch.float64)
    values = torch.linspace(-0.2, 2.5, 200, dtype=torch.float64)
    length = REACH / INTERVALS
    for row in log_slopes:
        found = tone_curve(values[:, None], row[None])[:, 0]
        assert bool((found.diff() > 0).all())
        for value, shown in zip(values.tolist(), found.tolist(), strict=True):
            total = min(value, 0.0) * math.exp(row[0])
            for k in range(INTERVALS):
                last = math.inf if k == INTERVALS - 1 else length
                total += math.exp(row[k]) * min(max(value - k * length, 0.0), last)
            assert shown == pytest.approx(total, abs=1e-12)
    several = tone_curve(values[:3, None], log_slopes)
    torch.testing.assert_close(several[1], tone_curve(values[1:2, None], log_slopes[1:2])[0])


def test_gradients_of_curves() -> None:
    draws = torch.Generator().manual_seed(1)
    values = 0.02 + 1.9 * torch.rand(6, 3, generator=draws, dtype=torch.float64)
    slopes = torch.randn(6, INTERVALS, generator=draws, dtype=torch.float64)
    assert torch.autograd.gradcheck(tone_curve, (values.requires_grad_(), slopes.requires_grad_()))
    assert torch.autograd.gradcheck(tone_curve, (values, slopes[:1].detach().requires_grad_()))
    for curve in (to_linear, to_srgb):
        assert torch.autograd.gradcheck(curve, (values,))


# -- bilateral grids --------------------------------------------------------------------------------------------------


def by_a_loop(grids: Tensor, images: Tensor, places: Tensor, guide: Tensor) -> Tensor:
    """Trilinear interpolation, one point and one vertex after the other."""
    sizes, rows = grids.shape[1:4], []
    for image, place, bright in zip(images.tolist(), places.tolist(), guide.tolist(), strict=True):
        positions = [min(max(p, 0.0), 1.0) * (n - 1) for p, n in zip((bright, place[1], place[0]), sizes, strict=True)]
        total = torch.zeros(grids.shape[-1], dtype=grids.dtype)
        for level in range(sizes[0]):
            for row in range(sizes[1]):
                for column in range(sizes[2]):
                    vertex = (level, row, column)
                    weight = math.prod(max(0.0, 1 - abs(p - v)) for p, v in zip(positions, vertex, strict=True))
                    total = total + weight * grids[(image, *vertex)]
        rows.append(total)
    return torch.stack(rows)


def some_points(count: int, grids: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    draws = torch.Generator().manual_seed(2)
    images = torch.randint(len(grids), (count,), generator=draws)
    places, guide = torch.rand(count, 2, generator=draws, dtype=torch.float64), torch.rand(count, generator=draws)
    return images, places, 1.4 * guide.double() - 0.2  # some are darker than black, some brighter than white


def test_slices_are_those_of_a_loop() -> None:
    grids = torch.randn(3, 4, 3, 5, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    points = some_points(60, grids)
    torch.testing.assert_close(sliced(grids, *points), by_a_loop(grids, *points))
    corners = torch.tensor([[0.0, 0.0], [1.0, 1.0], [2.0, -1.0]], dtype=torch.float64)
    ends, which = torch.tensor([0.0, 1.0, 1.0], dtype=torch.float64), torch.tensor([0, 1, 2])
    expected = torch.stack([grids[0, 0, 0, 0], grids[1, -1, -1, -1], grids[2, -1, 0, -1]])
    torch.testing.assert_close(sliced(grids, which, corners, ends), expected)


def test_gradients_of_slices() -> None:
    grids = torch.randn(2, 2, 3, 2, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    images, places, guide = some_points(5, grids)

    def slices(grids: Tensor, places: Tensor, guide: Tensor) -> Tensor:
        return sliced(grids, images, places, guide)

    inputs = [each.clone().requires_grad_() for each in (grids, places, guide)]
    assert torch.autograd.gradcheck(slices, inputs)
    image = guide[:4].view(2, 2).clone().requires_grad_()
    assert torch.autograd.gradcheck(sliced_image, (inputs[0].detach()[0].requires_grad_(), image))
    assert torch.autograd.gradcheck(variation, (inputs[0],))


def test_an_image_is_sliced_as_its_pixels_are() -> None:
    """Value and gradients."""
    draws = torch.Generator().manual_seed(0)
    grid = torch.randn(*GRID, AFFINE, dtype=torch.float64, generator=draws)
    guide = 1.2 * torch.rand(7, 9, dtype=torch.float64, generator=draws) - 0.1
    down, across = ((torch.arange(count, dtype=torch.float64) + 0.5) / count for count in (7, 9))
    places = torch.stack(torch.meshgrid(down, across, indexing="ij")[::-1], -1).view(-1, 2)
    wanted = torch.randn(7, 9, AFFINE, generator=draws)

    def of_rays(grid: Tensor, guide: Tensor) -> Tensor:
        return sliced(grid[None], torch.zeros(63, dtype=torch.int64), places, guide.view(-1)).view(7, 9, AFFINE)

    found = []
    for function in (sliced_image, of_rays):
        inputs = grid.clone().requires_grad_(), guide.clone().requires_grad_()
        value = function(*inputs)
        (value * wanted).sum().backward()
        found.append((value.detach(), *(each.grad for each in inputs)))
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one, other)


def test_a_grid_of_one_function_is_that_function() -> None:
    torch.manual_seed(0)
    grid, affine, behind = light_of("grid"), light_of("affine"), torch.rand(3)
    grid.vectors.data[2] = (MATRIX - IDENTITY).flatten().repeat(math.prod(GRID))
    affine.vectors.data[2] = (MATRIX - IDENTITY).flatten()
    rays, opacity, two = torch.rand(30, 3), torch.rand(30), torch.full((30,), 2)
    expected = affine.lit(rays, opacity, behind, two)
    torch.testing.assert_close(grid.lit(rays, opacity, behind, two, torch.rand(30, 2)), expected)
    torch.testing.assert_close(grid.lit(rays, opacity, behind, two), expected)
    image = rays.view(5, 6, 3), opacity.view(5, 6), behind, torch.tensor([2])
    torch.testing.assert_close(grid.lit(*image), expected.view(5, 6, 3))
    seen = without_background(rays, opacity, behind)
    torch.testing.assert_close(expected, transformed(seen, MATRIX) + (1 - opacity)[:, None] * behind)
    assert float(variation(grid.vectors.detach().view(-1, *GRID, AFFINE))) == 0


def test_for_any_view_a_grid_does_not_depend_on_the_position() -> None:
    torch.manual_seed(0)
    light, image, opaque = light_of("grid"), torch.rand(1, 1, 3).expand(6, 8, 3), torch.ones(6, 8)
    light.vectors.data[1] = 0.1 * torch.randn(light.size)
    own = light.vectors.detach()[1]
    with light.shown(own):
        assert float(light.lit(image, opaque, torch.zeros(3)).var(dim=(0, 1)).sum()) > 1e-5
    with light.shown(light.of_any_view(own)):
        uniform = light.lit(image, opaque, torch.zeros(3))
    torch.testing.assert_close(uniform, uniform[:1, :1].expand(6, 8, 3))
    grey = luminance(image[0, 0])
    mean = own.view(*GRID, AFFINE).mean((1, 2))[:, None, None].expand(*GRID, AFFINE)
    affine = sliced(mean[None], torch.zeros(1, dtype=torch.int64), torch.full((1, 2), 0.3), grey[None])[0].view(3, 4)
    expected = image[0, 0] + transformed(torch.cat([image[0, 0], torch.ones(1)]), affine)
    torch.testing.assert_close(uniform[0, 0], expected)


# -- learning ---------------------------------------------------------------------------------------------------------


def learnt(light: Light, shown: Tensor, show: Callable[[Tensor], Tensor], steps: int = 500) -> Tensor:
    """Learn the light of images together with the colours of the scene; return these."""
    colors = torch.full(shown.shape[1:], 0.5).requires_grad_()
    optimizer = torch.optim.Adam([{"params": [colors], "lr": 0.02}, {"params": light.parameters(), "lr": 0.01}])
    for _ in range(steps):
        optimizer.zero_grad()
        ((show(colors) - shown).square().mean() + SQUARED * light.penalty()).backward()
        optimizer.step()
    return colors.detach()


def as_rays(light: Light) -> Callable[[Tensor], Tensor]:
    """Return a function that shows the scene's colours (N, 3) in the light of each image, (M, N, 3)."""
    count = len(light.vectors)

    def show(colors: Tensor) -> Tensor:
        images = torch.arange(count).repeat_interleave(len(colors))
        rays = colors.repeat(count, 1)
        return light.lit(rays, torch.ones(len(rays)), torch.zeros(3), images).view(count, -1, 3)

    return show


@pytest.mark.medium
def test_gains_and_white_balances_are_found_and_the_mean_is_neutral() -> None:
    """The scene's colours and the functions can change together: only with a neutral mean is there one solution."""
    draws = torch.Generator().manual_seed(0)
    truth = 0.05 + 0.9 * torch.rand(150, 3, generator=draws)
    gains = torch.tensor([[1.3, 1.3, 1.3], [0.6, 0.6, 0.6], [1.1, 1.0, 0.8], [0.9, 1.0, 1.2]])
    light = light_of("affine")
    found = learnt(light, gains[:, None] * truth, as_rays(light))
    functions = IDENTITY + light.vectors.detach().view(4, 3, 4)
    expected = torch.cat([torch.diag_embed(gains / gains.mean(0)), torch.zeros(4, 3, 1)], dim=-1)
    torch.testing.assert_close(functions, expected, atol=0.05, rtol=0)
    torch.testing.assert_close(functions.mean(0), IDENTITY, atol=0.01, rtol=0)
    torch.testing.assert_close(found, gains.mean(0) * truth, atol=0.03, rtol=0)


@pytest.mark.medium
@pytest.mark.parametrize("stated", [True, False])
def test_exposures_are_found(stated: bool) -> None:
    """Exposures are compared in stops, whether files state them or not."""
    draws = torch.Generator().manual_seed(0)
    truth = 0.05 + 0.5 * torch.rand(150, 3, generator=draws)
    stops = torch.tensor([0.75, -1.0, 0.5, -0.25])
    shown = to_srgb(to_linear(truth) * 2 ** stops[:, None, None])
    light = light_of("tone", dataclasses.replace(SCENE, exposures=stops - stops.mean()) if stated else SCENE)
    colors = learnt(light, shown, as_rays(light))
    assert float((as_rays(light)(colors).detach() - shown).square().mean().sqrt()) < 0.01
    found = STOPS * light.of_images().detach()[:, :3]
    torch.testing.assert_close(found[:, 0], stops - stops.mean(), atol=0.15 if stated else 0.4, rtol=0)
    assert float(found[:, 1:].abs().max()) < 0.2


@pytest.mark.medium
def test_a_shade_at_a_border_takes_a_grid() -> None:
    """One of two images is darker towards its left edge. No single affine function is."""
    draws = torch.Generator().manual_seed(0)
    truth = 0.2 + 0.6 * torch.rand(10, 12, 3, generator=draws)
    shade = (0.5 + 0.5 * (torch.arange(12) + 0.5) / 12)[None, :, None]
    shown, scene = torch.stack([truth, shade * truth]), dataclasses.replace(SCENE, num_cameras=2)
    left = {}
    for kind in ("affine", "grid"):
        light = light_of(kind, scene)

        def show(colors: Tensor, light: Light = light) -> Tensor:
            images = torch.tensor([[0], [1]])
            return torch.stack([light.lit(colors, torch.ones(10, 12), torch.zeros(3), index) for index in images])

        colors = learnt(light, shown, show, 300)
        left[kind] = float((show(colors) - shown).square().mean().detach())
    assert left["grid"] < 0.3 * left["affine"]


# -- runs -------------------------------------------------------------------------------------------------------------


def dimmed(method: str, kind: str, folder: Path, out: Path, factors: Tensor, **settings: object) -> Trainer:
    """A trainer on the tiny data set with photographs darkened by factors (M,)."""
    still = tiny_trainer(method, folder, out / "still").train_set
    sizes, pixels = still.cameras.widths * still.cameras.heights, still.pixels.clone()
    pixels[:, :3] = (still.pixels[:, :3] * factors.repeat_interleave(sizes)[:, None]).round().to(torch.uint8)
    (out / "run").mkdir()
    run = tiny_run(method, folder, out / "run", max_eval_images=0, appearance=kind, **settings)
    return Trainer.of(run, dataclasses.replace(still, pixels=pixels))


@pytest.mark.parametrize(
    ("method", "kind"),
    [*(("instant-ngp", kind) for kind in KINDS), ("vanilla-nerf", "tone"), *(("gaussian-splatting", k) for k in KINDS)],
)
def test_every_method_has_every_kind(method: str, kind: str, shared_tiny: Path, tmp_path: Path) -> None:
    trainer = dimmed(method, kind, shared_tiny, tmp_path, torch.linspace(0.4, 1.0, 10), max_num_iterations=4)
    trainer.train()
    light = trainer.model.appearance
    assert isinstance(light, (AffineLight, ToneLight, GridLight))
    assert "appearance" in trainer.train_step().losses
    assert all(bool(parameter.any()) for parameter in light.parameters())
    view = trainer.train_set.view(0)
    assert bool(trainer.model.render_view(view, torch.zeros(3)).rgb.isfinite().all())


def test_rays_of_a_grid_know_their_position_in_the_image(shared_tiny: Path, tmp_path: Path) -> None:
    """Rays of a pixel are around its centre; other kinds do not use the position."""
    for kind in ("grid", "affine"):
        (tmp_path / kind).mkdir()
        trainer = dimmed("instant-ngp", kind, shared_tiny, tmp_path / kind, torch.ones(10))
        batch = trainer.source.draw(Request(step=0, num_pixels=64, rays_per_pixel=4))
        if kind != "grid":
            assert batch.rays.places is None
            continue
        flat = batch.pixels % 400  # of images of 20 x 20 pixels
        centers = torch.stack([flat % 20, flat // 20], -1) / 20 + 0.5 / 20
        places = batch.rays.places.view(64, 4, 2)
        torch.testing.assert_close(places.mean(1), centers, atol=1e-6, rtol=0)
        assert float((places - centers[:, None]).abs().max()) < 0.5 / 20


@pytest.mark.medium
@pytest.mark.parametrize("kind", KINDS)
def test_a_resumed_run_has_the_same_bits(kind: str, shared_tiny: Path, tmp_path: Path) -> None:
    factors, found = torch.linspace(0.4, 1.0, 10), []
    for name in ("whole", "first", "second"):
        (tmp_path / name).mkdir()
        found.append(dimmed("instant-ngp", kind, shared_tiny, tmp_path / name, factors, max_num_iterations=6))
    whole, first, second = found
    for trainer, steps in ((whole, 6), (first, 3)):
        for _ in range(steps):
            trainer.train_step()
    saved = first.save()
    assert saved is not None
    second.restore(load_checkpoint(saved))
    second.train()
    assert_same_bits(tensors(whole), tensors(second))


@pytest.mark.medium
@pytest.mark.parametrize("kind", ["tone", "grid"])
def test_half_of_a_dark_photograph_tells_its_light(
    kind: str, shared_tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And the nearest photograph, which is itself here, tells it too.

    Colours do not depend on the direction. Otherwise they would explain the light, since each camera has its own.
    """
    factors = torch.tensor([0.4, 1.0]).repeat(5)
    monkeypatch.setattr("nerfloom.rendering.light.RATE", 1e-2)
    settings = {"max_num_iterations": 200, "background": "black", "view_dependence": False}
    trainer = dimmed("instant-ngp", kind, shared_tiny, tmp_path, factors, **settings)
    trainer.train()
    light, found = trainer.model.appearance, {}
    assert light is not None
    for choice in ("mean", "half", "nearest"):
        light.held_out = choice  # type: ignore[assignment]
        found[choice] = evaluate(trainer.model, trainer.train_set, max_images=2).per_image[0]["psnr"]
    assert min(found["half"], found["nearest"]) > found["mean"] + 1
