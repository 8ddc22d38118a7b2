"""Closed forms of training: the learning rate by the clock, the ends of rays in each mode, and the fit of light."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from nerfloom.base.machine_config import MachineConfig
from nerfloom.data.dataset import Dataset
from nerfloom.data.pixels.batch import PixelBatch, draw_batch
from nerfloom.data.pixels.pixel_set import PixelSet
from nerfloom.data.scene import Scene
from nerfloom.data.sources import PixelSource, Request
from nerfloom.evaluation.appearance import fitted_appearance
from nerfloom.evaluation.error_bound import limited_error
from nerfloom.evaluation.evaluator import evaluate
from nerfloom.fields.base import Field
from nerfloom.geometry.points import Points
from nerfloom.geometry.rays import Rays, Samples
from nerfloom.kernels.math import scale_gradient
from nerfloom.losses.term import RenderedBatch
from nerfloom.losses.terms import Distortion
from nerfloom.registry import load_method
from nerfloom.rendering.volume import VolumeRenderer, volume_render
from nerfloom.samplers.choice import SamplingConfig, make_sampler
from nerfloom.samplers.occupancy import OccupancySampler
from nerfloom.training.checkpoint import load_checkpoint
from nerfloom.training.trainer import Trainer
from tests.conftest import TICK
from tests.test_nerfacto import captured
from tests.training.helpers import tiny_trainer

BOX = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
SCENE = Scene(BOX, 0.0, 10.0, 3, True, False, 20)


# -- the learning rate --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("schedule", ["exponential", "cosine", "hold-exponential"])
@pytest.mark.parametrize(("step", "seconds"), [(0, 0.0), (300, 20.0), (300, 60.0), (800, 60.0), (100, 95.0)])
def test_the_rate_falls_over_the_budget_that_is_further_spent(
    schedule: Any, step: int, seconds: float, shared_tiny: Path, tmp_path: Path
) -> None:
    """The budgets are 100 seconds and 1000 steps. Every headline figure is made with a budget of seconds."""
    trainer = tiny_trainer(
        "instant-ngp", shared_tiny, tmp_path / "run", max_seconds=100.0, max_num_iterations=1000, lr_schedule=schedule,
        learning_rate=0.02, lr_final=0.05, silhouette_cells=False, samples_per_batch=256,
    )  # fmt: skip
    trainer.prepare()  # which counts as training, so that it would take milliseconds off the budget
    trainer.state.step, trainer.state.seconds = step, seconds
    spent = max(step / 1000, seconds / 100)
    assert trainer.progress == pytest.approx(spent)
    trainer.train_step()
    factor = {
        "exponential": 0.05**spent,
        "cosine": 0.05 + 0.95 * (1 + math.cos(math.pi * spent)) / 2,
        "hold-exponential": 1.0 if spent < 0.5 else 0.05 ** (2 * spent - 1),
    }[schedule]
    assert [group["lr"] for group in trainer.optimizer.param_groups] == pytest.approx(
        [0.02 * factor] * len(trainer.optimizer.param_groups), rel=1e-4
    )


@pytest.mark.parametrize("given", [0.02, 0.005])
def test_a_resumed_run_goes_on_from_the_first_rate_that_its_settings_say(
    given: float, shared_tiny: Path, tmp_path: Path
) -> None:
    """Not from the rate that had fallen when it was saved; and a rate given anew counts from there on."""
    settings: dict[str, Any] = {
        "max_num_iterations": 100, "lr_schedule": "exponential", "lr_final": 0.01, "silhouette_cells": False,
        "samples_per_batch": 256,
    }  # fmt: skip
    saved = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "saved", learning_rate=0.02, **settings)
    saved.state.step = 59
    saved.train_step()
    resumed = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "resumed", learning_rate=given, **settings)
    resumed.restore(load_checkpoint(saved.save()))
    resumed.train_step()
    assert [group["lr"] for group in resumed.optimizer.param_groups] == pytest.approx(
        [given * 0.01**0.6] * len(resumed.optimizer.param_groups), rel=1e-5
    )


# -- where rays end -----------------------------------------------------------------------------------------------


class Fog(Field):
    """The same density everywhere."""

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        return torch.full((len(points),), 10.0), torch.zeros(len(points), 1)

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        return torch.ones(len(features), 3)


@pytest.mark.parametrize(("training", "stop"), [(False, 1e-4), (True, 1e-2)])
def test_rays_end_where_the_mode_says(training: bool, stop: float) -> None:
    """`--early-stop` and `--train-early-stop` define the ends, through the settings."""
    method = load_method("instant-ngp")
    config, _ = method.decided(dataclasses.replace(method.config, early_stop=1e-4, train_early_stop=1e-2), SCENE)
    assert isinstance(config, SamplingConfig)
    config = dataclasses.replace(config, num_steps=400, grid_resolution=8)
    sampler = make_sampler(config, SCENE).train(training)
    assert isinstance(sampler, OccupancySampler)
    count = 5
    rays = Rays(
        torch.tensor([[-3.0, 0.1, 0.2]]).repeat(count, 1), torch.tensor([[1.0, 0, 0]]).repeat(count, 1),
        torch.zeros(count), torch.full((count,), 9.0),
    )  # fmt: skip
    samples = sampler.sample(rays, Fog(), False)
    tau = 10 * sampler.step_size
    assert samples.counts.tolist() == [math.ceil(-math.log(stop) / tau)] * count


def test_rays_of_pictures_end_at_the_error_that_is_allowed() -> None:
    """Rays have the steps of a thick fog that let through more light than that; and as before afterwards."""
    config = dataclasses.replace(load_method("instant-ngp").config, early_stop=1e-4, train_early_stop=1e-2)
    config, _ = load_method("instant-ngp").decided(config, SCENE)
    assert isinstance(config, SamplingConfig)
    sampler = make_sampler(dataclasses.replace(config, num_steps=400, grid_resolution=8), SCENE).eval()
    assert isinstance(sampler, OccupancySampler)
    rays = Rays(torch.tensor([[-3.0, 0.1, 0.2]]), torch.tensor([[1.0, 0, 0]]), torch.zeros(1), torch.full((1,), 9.0))
    model: Any = torch.nn.ModuleList([sampler])
    for bound in (0.2, 1 / 255):
        with limited_error(model, bound):
            count = len(sampler.sample(rays, Fog(), False))
        assert count == math.ceil(-math.log(bound) / (10 * sampler.step_size))
    assert len(sampler.sample(rays, Fog(), False)) == math.ceil(-math.log(1e-4) / (10 * sampler.step_size))


# -- light --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def lit(shared_tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> Trainer:
    """A method that has learnt a little, and has another light for every photograph."""
    facts = {"unbounded": True, "appearance_varies": True}
    folder = tmp_path_factory.mktemp("lit")
    trainer = captured(shared_tiny, folder, facts, max_num_iterations=20, eval_appearance="half", background="white")
    trainer.train()
    vectors = trainer.model.field.appearance.vectors
    with torch.no_grad():
        vectors.copy_(torch.randn(vectors.shape, generator=torch.Generator().manual_seed(0)))
    return trainer


def changed(dataset: Dataset, first: int, last: int, kept: bool = False) -> Dataset:
    """The first photograph with other colours in some columns; which masks then ignore, if `kept`."""
    pixels, width = dataset.pixels.clone(), int(dataset.cameras.widths[0])
    here = torch.zeros(len(pixels), dtype=torch.bool)
    here[: width * int(dataset.cameras.heights[0])].view(-1, width)[:, first:last] = True
    pixels[here, :3] = 255 - pixels[here, :3]
    pixels[here, 3] = 255
    return dataclasses.replace(dataset, pixels=pixels, kept=PixelSet.of_mask(~here) if kept else dataset.kept)


@pytest.fixture
def _soon_fitted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nerfloom.evaluation.appearance.STEPS", 8)


def shown(trainer: Trainer, dataset: Dataset) -> Tensor:
    """The model's picture of the first view in the light that is found for it."""
    background = torch.ones(3)
    with fitted_appearance(trainer.model, dataset, 0, background):
        return trainer.model.render_view(dataset.view(0), background).rgb


@pytest.mark.medium
@pytest.mark.usefixtures("_soon_fitted")
def test_light_is_found_on_the_half_that_is_not_judged(lit: Trainer) -> None:
    width = int(lit.train_set.cameras.widths[0])
    plain = shown(lit, lit.train_set)
    assert torch.equal(shown(lit, changed(lit.train_set, width // 2, width)), plain)
    assert not torch.allclose(shown(lit, changed(lit.train_set, 0, width // 2)), plain, atol=1e-3)
    # Ignored pixels have no effect, anywhere in the image.
    for first, last in ((0, 4), (width - 4, width)):
        masked = [
            changed(dataset, first, last, True) for dataset in (lit.train_set, changed(lit.train_set, first, last))
        ]
        assert torch.equal(shown(lit, masked[0]), shown(lit, masked[1]))


def test_light_is_looked_for_left_of_the_middle_where_no_mask_is(lit: Trainer, monkeypatch: pytest.MonkeyPatch) -> None:
    """NeRF-W's protocol: the right half is judged."""
    given: list[Tensor] = []

    def noted(model: object, dataset: object, pixels: Tensor, background: Tensor) -> None:
        given.append(pixels)

    monkeypatch.setattr("nerfloom.evaluation.appearance.fit_appearance", noted)
    columns = torch.arange(len(lit.train_set.pixels)) % 20  # of images of 20 x 20 pixels
    left, unmasked = columns < 10, (columns < 3) | (columns >= 5) & (columns < 10)
    masked = changed(lit.train_set, 3, 5, kept=True)
    for index, dataset, wanted in ((0, lit.train_set, left), (2, lit.train_set, left), (0, masked, unmasked)):
        with fitted_appearance(lit.model, dataset, index, torch.ones(3)):
            pass
        seen = torch.zeros(len(columns), dtype=torch.bool)
        seen[given[-1]] = True
        of_image = torch.arange(len(columns)) // 400 == index
        assert torch.equal(seen, of_image & wanted)


@pytest.mark.usefixtures("_soon_fitted")
def test_the_half_on_which_light_is_found_is_not_judged(lit: Trainer) -> None:
    """The figure is measured on the right half of the very picture shown."""
    width = int(lit.train_set.cameras.widths[0])
    found = evaluate(lit.model, lit.train_set, max_images=1)
    assert found.eval_appearance == "half"
    rgba = lit.train_set.image(0)[:, width // 2 :].double() / 255
    truth = rgba[..., :3] * rgba[..., 3:] + (1 - rgba[..., 3:])
    picture = shown(lit, lit.train_set)[:, width // 2 :].double().clamp(0, 1)
    expected = -10 * math.log10(float((picture - truth).square().mean()))
    assert found.per_image[0]["psnr"] == pytest.approx(expected, abs=1e-3)


# -- a step -------------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("even_clock")
def test_training_takes_what_its_steps_take(shared_tiny: Path, tmp_path: Path) -> None:
    """The number of evaluations has no effect: the budget is in seconds."""
    trainer = tiny_trainer(
        "instant-ngp", shared_tiny, tmp_path / "run", evaluated=True, max_num_iterations=30,
        steps_per_eval_all_images=5, max_eval_images=1,
    )  # fmt: skip
    trainer.prepare()
    prepared = trainer.state.seconds
    trainer.train()
    assert trainer.state.seconds - prepared == pytest.approx(30 * TICK)


def test_the_seed_and_the_step_decide_what_is_drawn(shared_tiny: Path, tmp_path: Path) -> None:
    """This holds from equal parameters on, too: repeats of a comparison differ by their seeds."""
    drawn: list[Tensor] = []

    class Noting(PixelSource):
        def draw(self, request: Request) -> PixelBatch:
            batch = super().draw(request)
            drawn.append(batch.pixels)
            return batch

    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        trainer = tiny_trainer("vanilla-nerf", shared_tiny, tmp_path / name, machine=MachineConfig(seed=seed))
        trainer.prepare()
        trainer.source = Noting(trainer.train_set, "random", seed)
        trainer.train_step()
        trainer.train_step()
    first, second, again, _, other, _ = drawn
    assert torch.equal(first, again)
    assert not torch.equal(first, second)
    assert not torch.equal(first, other)


def test_adams_moments_decay_as_the_settings_say(shared_tiny: Path, tmp_path: Path) -> None:
    """After one step the mean is (1 - beta1) g and the mean square (1 - beta2) g^2."""
    trainer = tiny_trainer(
        "vanilla-nerf", shared_tiny, tmp_path / "run", adam_beta1=0.8, adam_beta2=0.96, adam_eps=1e-12
    )
    trainer.train_step()
    checked = 0
    for group in trainer.optimizer.param_groups:
        for parameter in group["params"]:
            state = trainer.optimizer.state[parameter]
            seen = state["exp_avg"].abs() > 1e-8
            ratio = state["exp_avg"][seen].double().square() / state["exp_avg_sq"][seen].double()
            checked += len(ratio)
            torch.testing.assert_close(ratio, torch.full_like(ratio, 0.2**2 / 0.04), rtol=1e-3, atol=0)
    assert checked > 100


def test_each_group_has_the_rate_and_the_schedule_that_it_names(shared_tiny: Path, tmp_path: Path) -> None:
    """Poses decay from the first step on, while the rest is held for half of the budget, and rise for 512 steps."""
    trainer = captured(
        shared_tiny, tmp_path, {"unbounded": True, "poses": "device"}, learning_rate=3e-3, camera_learning_rate=7e-4,
        lr_schedule="hold-exponential", lr_final=0.04, max_num_iterations=1000,
    )  # fmt: skip
    trainer.state.step = 250
    trainer.train_step()
    rates = {group["name"]: group["lr"] for group in trainer.optimizer.param_groups}
    expected = {"networks": 3e-3, "tables": 3e-3, "proposals": 1e-2, "poses": 251 / 512 * 7e-4 * 0.04**0.25}
    assert rates == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize(("seconds", "size"), [(20.0, 16), (60.0, 17), (120.0, 18), (300.0, 18), (None, 18)])
def test_longer_runs_of_instant_ngp_get_larger_tables(
    seconds: float | None, size: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)  # the times were found for these
    method = load_method("instant-ngp")
    config, _ = method.decided(dataclasses.replace(method.config, max_seconds=seconds), SCENE)
    assert config.log2_table_size == size
    assert config.sparse_updates == (size >= 17)


def test_a_pixel_is_several_rays_from_the_share_of_the_budget_on_that_is_asked_for(
    shared_tiny: Path, tmp_path: Path
) -> None:
    trainer = tiny_trainer(
        "vanilla-nerf", shared_tiny, tmp_path / "run", rays_per_pixel=4, train_rays_per_pixel_from=0.5,
        max_num_iterations=10,
    )  # fmt: skip
    counts = []
    for step in range(10):
        trainer.state.step = step
        before = trainer.state.rays
        trainer.train_step()
        counts.append(trainer.state.rays - before)
        assert trainer._request().rays_per_pixel == (4 if step + 1 >= 5 else 1)
    assert counts == [128] * 10  # fewer pixels, of as many rays


def test_the_coarse_network_learns_by_its_own_colours(shared_tiny: Path, tmp_path: Path) -> None:
    """NeRF, equation 6: the squared errors of both levels are added; the samples drawn by the coarse level pass no
    gradient back."""
    trainer = tiny_trainer("vanilla-nerf", shared_tiny, tmp_path / "run")
    model, batch = trainer.model.train(), draw_batch(trainer.train_set, 32, "black")
    parameters = list(model.sampler.parameters())
    torch.manual_seed(1)
    found = torch.autograd.grad(model.loss(batch, 0).total, parameters)
    torch.manual_seed(1)
    coarse = model.render(batch.rays, batch.background).coarse
    assert coarse is not None
    expected = torch.autograd.grad((coarse.rgb - batch.rgb).square().mean(), parameters)
    for ours, theirs in zip(found, expected, strict=True):
        assert theirs.abs().max() > 0
        torch.testing.assert_close(ours, theirs)


# -- what nerfacto adds -------------------------------------------------------------------------------------------


def test_what_is_near_a_camera_learns_little(
    shared_tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Gradients are scaled by the squared distance, in half edges of the box, and by 1 beyond one of them."""
    trainer = captured(shared_tiny, tmp_path, {"unbounded": True, "near": 0.05})
    shown, given, values = list[Samples](), list[Tensor](), VolumeRenderer.values

    def shaded(self: VolumeRenderer, rays: Rays, samples: Samples, field: Field) -> tuple[Tensor, Tensor]:
        shown.append(samples)
        return values(self, rays, samples, field)

    def noted(values: Tensor, factors: Tensor) -> Tensor:
        given.append(factors)
        return scale_gradient(values, factors)

    monkeypatch.setattr(VolumeRenderer, "values", shaded)
    monkeypatch.setattr("nerfloom.rendering.volume.scale_gradient", noted)
    trainer.train_step()
    (samples,), (factors, of_colors) = shown, given
    assert of_colors is factors
    half = float((trainer.model.scene.box[1] - trainer.model.scene.box[0])[0]) / 2
    torch.testing.assert_close(factors, (samples.t / half).square().clamp(max=1))
    assert factors.min() < 0.1
    assert factors.max() == 1


def test_light_is_gathered_in_normalised_distance(shared_tiny: Path, tmp_path: Path) -> None:
    """mip-NeRF 360, equation 15, by all pairs, of the intervals that the sampler works with."""
    trainer = captured(shared_tiny, tmp_path, {"unbounded": True}, distortion_loss_mult=0.5)
    model = trainer.model.train()
    batch = draw_batch(trainer.train_set, 6, "black")
    rendered = model.render(batch.rays, torch.zeros(6, 3))
    assert rendered.samples is not None
    assert rendered.samples.edges is not None
    edges, weights = rendered.samples.edges.double(), rendered.samples.padded(rendered.weights).detach().double()
    middles = (edges[:, 1:] + edges[:, :-1]) / 2
    apart = (middles[:, :, None] - middles[:, None]).abs()
    pairs = (weights[:, :, None] * weights[:, None] * apart).sum((1, 2))
    expected = 0.5 * (pairs + (weights.square() * edges.diff(dim=-1)).sum(-1) / 3).mean()
    term = Distortion()
    found = term.factor(model.config, 0) * term(RenderedBatch(batch, rendered, model, 0))
    assert float(found.detach()) == pytest.approx(float(expected), rel=1e-3)
    assert any(isinstance(each, Distortion) for each in model.losses)


@pytest.mark.parametrize(("has_alpha", "opacity"), [(False, 1.0), (True, 0.0)])
def test_a_ray_of_a_capture_ends_in_matter_unless_photographs_tell_what_is_empty(
    has_alpha: bool, opacity: float
) -> None:
    """The sky of a photograph without alpha is not a hole, however thin the matter there."""
    settings = {"sampler": "proposal", "num_proposal_samples": (8,), "num_nerf_samples": 8}
    config: Any = dataclasses.replace(load_method("nerfacto").config, **settings)
    scene = dataclasses.replace(SCENE, unbounded=True, has_alpha=has_alpha, near=0.05, far=1000.0)
    count = 4
    rays = Rays(
        torch.zeros(count, 3), torch.eye(3)[[0, 1, 2, 0]], torch.full((count,), 0.05), torch.full((count,), 1e3)
    )
    samples = make_sampler(config, scene).eval().sample(rays, Fog(), False)
    thin = torch.full((len(samples),), 1e-7)
    rendered = volume_render(rays, samples, thin, torch.ones(len(samples), 3), torch.zeros(3))
    torch.testing.assert_close(rendered.accumulation, torch.full((count,), opacity), atol=1e-3, rtol=0)
