"""Gaussians that move: their equations, training on moving discs, their growth, pictures, files and runs."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import Image
from torch import Tensor

from nerfloom import View
from nerfloom.base.errors import ConfigError
from nerfloom.cameras.poses import Placement
from nerfloom.cli import evaluate as eval_command
from nerfloom.cli import export as export_command
from nerfloom.cli import render as render_command
from nerfloom.data.pixels.batch import ViewBatch
from nerfloom.export.web import gaussians_of
from nerfloom.kernels.splats.project import MIN_ALPHA
from nerfloom.methods.moving_gaussians import (
    MAX_LOGIT,
    METHOD,
    MovingGaussians,
    MovingGaussiansConfig,
    decide,
    faded,
    shown_at,
    still,
)
from nerfloom.splats.drawing import draw_colors, splat_camera
from nerfloom.splats.files import read_gaussians
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.rasteriser import RASTERISER
from nerfloom.testing.method_under_test import Learner
from nerfloom.testing.scenes import moving_ball
from nerfloom.training.checkpoint import load_checkpoint
from nerfloom.training.optim import make_optimizer, set_learning_rate
from nerfloom.training.trained import load_trained
from nerfloom.training.trainer import Trainer
from tests.conftest import EditJson, Refused
from tests.splats.test_files import exported, pretend
from tests.splats.test_method import SCENE, ball, camera
from tests.training.helpers import assert_same_bits, tensors, tiny_trainer

MOVING = dataclasses.replace(SCENE, moving=True, num_times=8)
FEW: dict[str, Any] = {"start": "random", "num_gaussians": 600, "start_gaussians": 400, "steps_per_move": 20}
PLAIN: dict[str, Any] = {"opacity_penalty": 0.0, "scale_penalty": 0.0, "noise": 0.0, "appearance": "none"}
"""Settings with a loss of colours alone."""
TIMES = [index / 7 for index in range(8)]
BLACK = torch.zeros(3)


def model_of(gaussians: Gaussians | None = None, **settings: Any) -> MovingGaussians:
    """A model on a scene that moves, with the given Gaussians."""
    config, _ = METHOD.decided(dataclasses.replace(METHOD.config, **{**FEW, **settings}), MOVING)
    model = MovingGaussians(config, MOVING)
    if gaussians is not None:
        model.set_gaussians(gaussians)
    return model


def moving(gaussians: Gaussians, velocity: list[float], moment: float, duration: float) -> Gaussians:
    """Gaussians that all move alike."""
    one, like = torch.ones_like(gaussians.logits), gaussians.log_scales
    extras = {
        "velocities": torch.tensor(velocity).to(like).expand(len(gaussians), 3).clone(),
        "moments": moment * one,
        "log_durations": math.log(duration) * one,
    }
    return dataclasses.replace(gaussians, extras=extras)


def disc(**changes: Any) -> Gaussians:
    """A Gaussian with as many harmonics as the method has."""
    return ball(harmonics=torch.zeros(1, 3, 15), **changes)


def batch_of(target: Tensor, time: float) -> ViewBatch:
    return ViewBatch(0, View(camera(), time), target, BLACK)


def picture(gaussians: Gaussians) -> Tensor:
    return draw_colors(gaussians, splat_camera(camera(), 0.2), 1, BLACK)


# -- the equations ----------------------------------------------------------------------------------------------------


def some(count: int, dtype: torch.dtype = torch.float64) -> Gaussians:
    """Random Gaussians in front of `camera`, wide and translucent enough that no pixel is at the edge of one."""
    torch.manual_seed(3)
    extras = {
        "velocities": torch.randn(count, 3), "moments": torch.rand(count), "log_durations": torch.randn(count) / 3 - 0.5
    }  # fmt: skip
    found = Gaussians(
        torch.randn(count, 3) / 5, torch.randn(count, 3) / 9 + 0.4, torch.randn(count, 4), torch.randn(count) / 2,
        torch.randn(count, 3), torch.zeros(count, 3, 0), extras,
    )  # fmt: skip
    return found.map(lambda values: values.to(dtype))


@pytest.mark.parametrize("time", [0.0, 0.3, 1.0])
def test_positions_and_opacities_are_the_equations(time: float) -> None:
    given = some(50)
    shown = shown_at(given, time)
    for index in range(len(given)):
        moment, duration = float(given.extras["moments"][index]), math.exp(given.extras["log_durations"][index])
        velocity = given.extras["velocities"][index]
        opacity = math.exp(-0.5 * ((time - moment) / duration) ** 2) / (1 + math.exp(-given.logits[index]))
        torch.testing.assert_close(shown.means[index], given.means[index] + velocity * (time - moment))
        assert float(torch.sigmoid(shown.logits[index])) == pytest.approx(opacity, rel=1e-12)
    for name in ("log_scales", "rotations", "colors", "harmonics"):
        assert torch.equal(getattr(shown, name), getattr(given, name))
    assert not shown.extras  # a moment of them stands still


def test_at_their_moment_gaussians_are_at_rest() -> None:
    given = moving(some(20, torch.float32), [1.0, 2.0, 3.0], 0.25, 0.1)
    shown = shown_at(given, 0.25)
    assert torch.equal(shown.means, given.means)
    assert torch.equal(shown.logits, given.logits)


def test_opacities_keep_their_digits_and_gradients_are_finite() -> None:
    """For any opacity and any factor of it, in float32 as in float64."""
    logits = torch.tensor([-60.0, -9.0, 0.0, 5.0, 14.0, 25.0, MAX_LOGIT, 80.0, 1e4])[:, None].expand(-1, 7)
    factors = torch.tensor([0.0, -1e-9, -1e-4, -0.7, -12.0, -80.0, -5e7]).expand(9, -1)
    x, low = (values.flatten().clone().requires_grad_() for values in (logits, factors))
    found = torch.sigmoid(faded(x, low))
    expected = torch.sigmoid(logits.flatten().double()) * factors.flatten().double().exp()
    torch.testing.assert_close(found.detach().double(), expected, atol=1e-6, rtol=0)
    for gradient in torch.autograd.grad(found.sum(), (x, low)):
        assert bool(gradient.isfinite().all())
        assert float(gradient.min()) > -1e-6  # more opaque at rest, or less faded, is more opaque


@pytest.mark.parametrize("name", ["velocities", "moments", "log_durations", "means", "logits"])
def test_gradients_are_finite_differences(name: str) -> None:
    """Through a small drawing, in float64: the mean of its colours with fixed weights."""
    given, view = some(4), splat_camera(camera(), 0.2)
    view = dataclasses.replace(view, pose=view.pose.double())
    weights = torch.rand(33, 33, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))

    def drawn(values: Tensor) -> Tensor:
        columns = {**given.columns, name: values}
        shown = RASTERISER.project(shown_at(Gaussians.of(columns), 0.8), view)
        return (weights * RASTERISER.draw(shown, view, BLACK.double()).image).mean()

    values = given.columns[name].clone().requires_grad_()
    (gradient,) = torch.autograd.grad(drawn(values), values)
    step, differences = 1e-6, torch.zeros_like(values)
    with torch.no_grad():
        for index in range(values.numel()):
            moved = torch.zeros(values.numel(), dtype=torch.float64)
            moved[index] = step
            ahead, back = (drawn(values + sign * moved.view_as(values)) for sign in (1, -1))
            differences.view(-1)[index] = (ahead - back) / (2 * step)
    print(name, float(gradient.abs().max()), float((gradient - differences).abs().max()))
    assert float(gradient.abs().min()) > 0
    torch.testing.assert_close(gradient, differences, rtol=1e-4, atol=1e-4 * float(gradient.abs().max()))


# -- the loss ---------------------------------------------------------------------------------------------------------


def test_what_stands_still_gives_velocities_no_gradient() -> None:
    """Images of the Gaussians as they are leave nothing to learn; images of others that have moved do."""
    model = model_of(moving(disc(logit=1.0), [0.0, 0.0, 0.0], 0.5, 1.0), **PLAIN)
    same = model.loss(batch_of(torch.zeros(33, 33, 3), 1.0), 0).rgb
    shifted = picture(disc(logit=1.0, means=torch.tensor([[0.1, 0.0, 0.0]])))
    found = []
    for target in (same, shifted):
        model.zero_grad()
        model.loss(batch_of(target, 1.0), 0).total.backward()
        gradient = model.columns["velocities"].values.grad
        assert gradient is not None
        found.append(gradient[0])
    print(found)
    assert float(found[0].abs().max()) < 1e-4 * float(found[1].abs().max())
    assert float(found[1][0]) < 0  # a larger velocity along x is better


def test_the_penalty_counts_what_is_seen_and_shortens_no_duration() -> None:
    """The paper's 4D regularisation: the mean of opacities times a factor of time that has no gradient."""
    given = moving(disc(logit=0.3), [0.0, 0.0, 0.0], 0.2, 0.5)
    model = model_of(given, **{**PLAIN, "opacity_penalty": 0.4})
    term = model.loss(batch_of(torch.zeros(33, 33, 3), 0.9), 0).terms["opacity"]
    factor = math.exp(-0.5 * (0.7 / 0.5) ** 2)
    opacity = 1 / (1 + math.exp(-0.3))
    assert float(term.detach()) == pytest.approx(0.4 * opacity * factor, rel=1e-5)
    term.backward()
    gradient = model.columns["logits"].values.grad
    assert gradient is not None
    assert float(gradient[0, 0]) == pytest.approx(0.4 * opacity * (1 - opacity) * factor, rel=1e-5)
    for name in ("moments", "log_durations", "velocities"):
        values = model.columns[name].values.grad
        assert values is None or not bool(values.any())


@pytest.mark.medium
def test_moving_discs_are_followed() -> None:
    """Two discs cross the image at 8 times. Their paths are learnt from their positions at half of the time.

    The largest distance from the true paths falls below 0.08 units, 1.1 pixels; at the start it is 0.45.
    """
    velocities = torch.tensor([[0.8, 0.0, 0.0], [-0.6, 0.2, 0.0]])
    pair = disc(logit=2.0)[torch.tensor([0, 0])]
    colors = torch.tensor([[1.0, -1.0, -1.0], [-1.0, 1.0, -1.0]])
    pair = dataclasses.replace(pair, means=torch.tensor([[0.0, 0.35, 0.0], [0.1, -0.4, 0.0]]), colors=colors)
    truth = moving(pair, [0.0, 0.0, 0.0], 0.5, 100.0)
    truth = dataclasses.replace(truth, extras={**truth.extras, "velocities": velocities})
    targets = [picture(shown_at(truth, time)) for time in TIMES]

    start = dataclasses.replace(pair, means=pair.means + torch.tensor([[0.05, -0.05, 0.0], [-0.05, 0.05, 0.0]]))
    rates = {"rate_factor": 1.0, "position_rate": 5e-4, "velocity_rate": 1.6e-2}
    model = model_of(moving(start, [0.0, 0.0, 0.0], 0.5, 1.0), **PLAIN, **rates)
    optimizer, steps = make_optimizer(model, model.config), 320

    @torch.no_grad()
    def farthest() -> float:
        true, found = ([shown_at(each, time).means for time in TIMES] for each in (truth, model.at_rest()))
        return max(float((a - b)[:, :2].norm(dim=1).max()) for a, b in zip(true, found, strict=True))

    before = farthest()
    for step in range(steps):
        index = 3 * step % len(TIMES)
        set_learning_rate(optimizer, model.config, step, step / steps)
        optimizer.zero_grad()
        model.loss(batch_of(targets[index], TIMES[index]), step).total.backward()
        optimizer.step()
    after = farthest()
    print(before, after, model.gaussians().extras)
    assert before > 0.4
    assert after < 0.08


# -- rows -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("strategy", ["adc", "mcmc", "relocation"])
def test_growth_keeps_the_columns_of_a_gaussian_together(strategy: str) -> None:
    """Copies move as their originals."""
    config = dataclasses.replace(METHOD.config, **FEW, strategy=strategy, steps_per_reset=10**6)
    found, count = Learner(METHOD, config, moving_ball(), 0), 400
    model = found.model
    assert isinstance(model, MovingGaussians)
    tags = torch.arange(count).float()
    tagged = tags[:, None].expand(-1, 3).contiguous()
    first = disc(logit=0.5)[torch.zeros(count, dtype=torch.long)]
    extras = {"velocities": tagged, "moments": tags / count, "log_durations": tags / count}
    model.set_gaussians(dataclasses.replace(first, colors=tagged, extras=extras))
    model.columns["logits"].values.data[::3] = -9.0  # are dropped, or moved
    grows: Any = model.strategy
    if strategy != "mcmc":
        grows.gradients.sums = torch.ones(count, 2)
    for change in model.after_step(0, 0.0):
        found.optimizer.change_rows(change)
    grown = model.gaussians()
    assert len(grown) != count or not torch.equal(grown.colors, first.colors)
    assert set(grown.colors[:, 0].tolist()) <= set(tags.tolist())
    torch.testing.assert_close(grown.extras["velocities"], grown.colors)
    torch.testing.assert_close(grown.extras["moments"], grown.colors[:, 0] / count)
    torch.testing.assert_close(grown.extras["log_durations"], grown.colors[:, 0] / count)


def test_gaussians_without_motion_stand_still_at_random_moments() -> None:
    many = disc()[torch.zeros(2_000, dtype=torch.long)]
    torch.manual_seed(5)
    extras = model_of(many, start_duration=0.7).gaussians().extras
    assert not bool(extras["velocities"].any())
    torch.testing.assert_close(extras["log_durations"].exp(), torch.full((2_000,), 0.7))
    moments = extras["moments"].sort().values
    assert float((moments - torch.linspace(0, 1, 2_000)).abs().max()) < 0.05  # uniform, by Kolmogorov's distance
    given = moving(many, [1.0, 2.0, 3.0], 0.2, 0.3)
    for name, values in model_of(given).gaussians().extras.items():
        torch.testing.assert_close(values, given.extras[name])


def test_durations_stay_above_the_minimum() -> None:
    model = model_of(moving(disc(), [0.0, 0.0, 0.0], 0.5, 0.3), min_duration=0.25)
    model.columns["log_durations"].values.data -= 3.0
    model.after_every_step(0, 0.0, True)
    assert float(model.gaussians().extras["log_durations"].exp()) == pytest.approx(0.25)
    short = model_of(disc(), min_duration=0.25, start_duration=0.1)
    assert float(short.gaussians().extras["log_durations"].exp()) == pytest.approx(0.25)


def test_moments_stay_within_the_time_of_the_images() -> None:
    """Before and after it no image would show a short one, which would be kept and copied all the same."""
    model = model_of(moving(disc()[torch.zeros(3, dtype=torch.long)], [0.0, 0.0, 0.0], 0.5, 0.3))
    model.columns["moments"].values.data += torch.tensor([[-0.7], [0.2], [0.9]])
    model.after_every_step(0, 0.0, True)
    torch.testing.assert_close(model.gaussians().extras["moments"], torch.tensor([0.0, 0.7, 1.0]))


def test_a_still_scene_has_no_columns_of_motion() -> None:
    config, made = decide(MovingGaussiansConfig(**FEW), SCENE)
    model = MovingGaussians(config, SCENE)
    assert not model.gaussians().extras
    assert {decision.option: decision.choice for decision in made}["motion"] == "left out"
    assert model.start_without_points() == "field"


@pytest.mark.parametrize(("unbounded", "kind"), [(False, "random"), (True, "field")])
def test_a_scene_without_a_box_starts_on_a_field(unbounded: bool, kind: str) -> None:
    scene = dataclasses.replace(MOVING, unbounded=unbounded)
    config, _ = METHOD.decided(dataclasses.replace(METHOD.config, **{**FEW, "start": "auto"}), scene)
    assert MovingGaussians(config, scene).start_without_points() == kind
    assert config.field_depth_mult == 0.0  # a field of all times tells no distance at one


def test_the_minimum_duration_follows_the_images_times() -> None:
    for scene, expected in (
        (MOVING, 1 / 16),
        (dataclasses.replace(MOVING, num_times=150, num_cameras=3_000), 1 / 300),
        (dataclasses.replace(MOVING, num_times=0, num_cameras=20), 1 / 40),
        (dataclasses.replace(MOVING, num_times=20_000), 1e-4),  # the least that may be set
    ):
        config, made = decide(MovingGaussiansConfig(), scene)
        assert config.min_duration == pytest.approx(expected)
        assert "min duration" in {decision.option for decision in made}
    assert decide(MovingGaussiansConfig(min_duration=0.3), MOVING)[0].min_duration == 0.3


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"min_duration": 0.0}, "--min-duration is 0.0; it must be from 0.0001 to 1000"),
        ({"start_duration": -1.0}, "--start-duration is -1.0; it must be from 0.0001 to 1000"),
        ({"velocity_rate": -1.0}, "--velocity-rate is -1.0; it must be"),
    ],
)
def test_settings_out_of_range_are_refused(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError) as error:
        MovingGaussiansConfig(**settings)
    assert words in str(error.value)


# -- pictures and files -----------------------------------------------------------------------------------------------


def test_pictures_are_of_their_time() -> None:
    """A disc that moves to the right and is gone at the end, in both ways of drawing."""
    model = model_of(moving(disc(), [1.0, 0.0, 0.0], 0.25, 0.2))
    middles, light = {}, {}
    columns = torch.arange(33.0)
    for time in (0.0, 0.0, 0.0, 0.5, 0.5, 0.25):
        image = model.render_rgb(View(camera(), time), BLACK)
        torch.testing.assert_close(image, model.render_view(View(camera(), time), BLACK).rgb, atol=1e-5, rtol=0)
        middles[time], light[time] = float((image.sum((0, 2)) * columns).sum() / image.sum()), float(image.max())
    shift = 0.25 * 40 / 3  # 40 pixels at distance 3
    assert middles[0.5] - middles[0.25] == pytest.approx(shift, abs=0.1)
    assert middles[0.25] - middles[0.0] == pytest.approx(shift, abs=0.1)
    fading = math.exp(-0.5 * (0.25 / 0.2) ** 2)
    assert light[0.0] / light[0.25] == pytest.approx(fading, abs=0.03)
    assert light[0.5] == pytest.approx(light[0.0], abs=1e-3)
    assert not bool(model.render_rgb(View(camera(), 1.0), BLACK).any())
    assert len(model.gaussians(1.0)) == 0  # 3.75 durations later
    assert len(model.gaussians()) == 1


def test_gaussians_at_a_time_are_those_that_are_seen() -> None:
    given = some(200, torch.float32)
    given = dataclasses.replace(given, harmonics=torch.zeros(200, 3, 15))
    model = model_of(given)
    for time in (0.0, 0.4, 1.0):
        shown = shown_at(model.gaussians(), time)
        kept = model.gaussians(time)
        torch.testing.assert_close(kept.means, shown.means[torch.sigmoid(shown.logits) > MIN_ALPHA])
    broken = dataclasses.replace(given, logits=given.logits.clone().index_fill_(0, torch.tensor([7]), math.nan))
    assert int((~model_of(broken).gaussians(0.4).finite()).sum()) == 1  # it is not hidden


@pytest.mark.parametrize("suffix", ["ply", "spz"])
def test_a_time_and_a_sequence_are_exported(suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = model_of(moving(disc(), [1.0, 2.0, 4.0], 0.5, 10.0))
    pretend(monkeypatch, model, Placement.of(None, 1.0), "moving-gaussians")
    exported(monkeypatch, tmp_path, suffix, "--time", "0.75")
    found = read_gaussians(tmp_path / f"splat.{suffix}").gaussians
    torch.testing.assert_close(found.means, torch.tensor([[0.25, 0.5, 1.0]]), atol=1e-3, rtol=0)
    exported(monkeypatch, tmp_path / "frames", suffix, "--num-frames", "3")
    files = sorted((tmp_path / "frames").glob(f"*.{suffix}"))
    assert [file.name for file in files] == [f"splat_000{index}.{suffix}" for index in range(3)]
    for file, away in zip(files, (-0.5, 0.0, 0.5), strict=True):
        expected = away * torch.tensor([[1.0, 2.0, 4.0]])
        torch.testing.assert_close(read_gaussians(file).gaussians.means, expected, atol=1e-3, rtol=0)


def test_times_that_cannot_be_exported_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: Refused
) -> None:
    given = ("gaussian-splat", tmp_path / "run", "--output-dir", tmp_path)
    main, placement = export_command.main, Placement.of(None, 1.0)
    pretend(monkeypatch, model_of(moving(disc(), [0.0, 0.0, 0.0], 0.0, 0.1)), placement, "moving-gaussians")
    assert "--num-frames is 0" in refused(main, *given, "--num-frames", 0, status=2)
    both = refused(main, *given, "--num-frames", 3, "--time", 0.5, status=2)
    assert "--num-frames" in both
    assert "--time" in both
    assert "no Gaussians left at time 1" in refused(main, *given, "--time", 1)
    config, _ = decide(MovingGaussiansConfig(**FEW), SCENE)
    pretend(monkeypatch, MovingGaussians(config, SCENE), placement, "moving-gaussians")
    assert "--num-frames 3: the photographs of this run have no times" in refused(main, *given, "--num-frames", 3)
    assert sorted(tmp_path.iterdir()) == []


# -- runs -------------------------------------------------------------------------------------------------------------


@pytest.fixture
def moving_data(tiny: Path, edit_json: EditJson) -> Path:
    """The tiny data set, with images of ten times."""
    edit_json(lambda content: [frame.update(time=index / 9) for index, frame in enumerate(content["frames"])])
    return tiny


def trainer_on(data: Path, folder: Path, **settings: Any) -> Trainer:
    return tiny_trainer("moving-gaussians", data, folder, **{"start": "auto", "steps_per_move": 10, **settings})


def test_a_run_starts_anywhere_and_refuses_a_hull(moving_data: Path, tmp_path: Path) -> None:
    trainer = trainer_on(moving_data, tmp_path / "run")
    trainer.prepare()
    model = trainer.model
    assert isinstance(model, MovingGaussians)
    gaussians, box = model.gaussians(), trainer.train_set.scene.box
    assert len(gaussians) == 400
    assert bool(((gaussians.means >= box[0]) & (gaussians.means <= box[1])).all())
    assert float(gaussians.means.std(0).min()) > 0.2 * float((box[1] - box[0]).max())
    assert float(gaussians.extras["moments"].std()) == pytest.approx(12**-0.5, abs=0.03)
    hull = trainer_on(moving_data, tmp_path / "hull", start="silhouettes")
    with pytest.raises(ConfigError, match="--start silhouettes: this scene moves"):
        hull.prepare()


@pytest.mark.medium
@pytest.mark.parametrize("strategy", ["adc", "mcmc", "relocation"])
def test_a_run_goes_on_with_the_same_bits(strategy: str, moving_data: Path, tmp_path: Path) -> None:
    settings = {"strategy": strategy, "steps_per_reset": 20, "max_num_iterations": 60}
    whole, parts, resumed = (trainer_on(moving_data, tmp_path / str(number), **settings) for number in range(3))
    for trainer, steps in ((whole, 38), (parts, 15)):
        for _ in range(steps):
            trainer.train_step()
    resumed.restore(load_checkpoint(parts.save()))
    torch.rand(7)
    for _ in range(23):
        resumed.train_step()
    assert_same_bits(tensors(whole), tensors(resumed))
    assert whole.state.skipped == 0


@pytest.mark.medium
def test_commands_show_a_run_at_its_times(
    moving_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Evaluation of images with times, a video of time, a page and files of a moment."""
    trainer = trainer_on(moving_data, tmp_path / "run", max_num_iterations=40)
    trainer.train()
    run = trainer.folder / "config.yml"

    def command(main: Any, *words: object) -> None:
        monkeypatch.setattr("sys.argv", ["command", *map(str, words)])
        main()

    command(eval_command.main, run, "--split", "train", "--output-path", tmp_path / "eval.json")
    assert json.loads((tmp_path / "eval.json").read_text())["results"]["psnr"] > 5
    video = ("--load-config", run, "--num-frames", 3, "--split", "train", "--output-path", tmp_path / "time.gif")
    command(render_command.main, "time", *video)
    with Image.open(tmp_path / "time.gif") as frames:
        assert getattr(frames, "n_frames", 1) > 1
    capsys.readouterr()
    command(export_command.main, "web", run, "--output-dir", tmp_path, "--time", 0.25)
    said = capsys.readouterr().err
    assert "time 0.25, still" in said
    assert float(said.split("PSNR ")[1].split(" dB")[0]) > 30  # against the method's own pictures at that time
    page = gaussians_of((tmp_path / "scene.html").read_text(encoding="utf-8"))
    there = load_trained(run).model.gaussians(0.25)
    torch.testing.assert_close(page.means, there.means, atol=1e-3, rtol=0)
    command(export_command.main, "gaussian-splat", run, "--output-dir", tmp_path / "frames", "--num-frames", 2)
    assert len(list((tmp_path / "frames").glob("splat_*.ply"))) == 2


def test_still_columns_are_as_many_as_the_gaussians() -> None:
    columns = still(disc()[torch.zeros(5, dtype=torch.long)], 0.5)
    assert {name: values.shape for name, values in columns.items()} == {
        "velocities": (5, 3), "moments": (5,), "log_durations": (5,)
    }  # fmt: skip
