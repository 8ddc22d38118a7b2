"""The list of conditions: complete, selectable, and each a scene with matching settings."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from nerfloom.base.errors import ConfigError
from nerfloom.base.plain import from_plain
from nerfloom.cli.stress import USAGE
from nerfloom.data.sources import make_source
from nerfloom.registry import load_method
from nerfloom.stress.conditions import CONDITIONS, PLAIN, Condition, select
from nerfloom.stress.scenes import ball_views
from nerfloom.stress.trial import MAX_RAYS, MAX_SAMPLES, Budget, StressedSource, shortened
from nerfloom.training.run import Run, create_folder
from nerfloom.training.trainer import Trainer
from tests.training.helpers import tiny_run

BALL = ball_views()
BY_NAME = {condition.name: condition for condition in CONDITIONS}


def test_names_are_unique_and_the_help_lists_them_all() -> None:
    assert len(BY_NAME) == len(CONDITIONS)
    words = USAGE.replace(",", " ").split()
    assert [name for name in BY_NAME if name not in words and name != "plain"] == []


def test_the_document_says_what_each_may_lose() -> None:
    text = (Path(__file__).parents[2] / "docs" / "notes" / "stress.md").read_text(encoding="utf-8")
    table = text.split("| condition | dB that may be lost, and why |\n")[1].split("\n\n")[0]
    rows = [line.split("|")[1:3] for line in table.splitlines()]
    said = {name.strip(): allowed.strip() for names, allowed in rows for name in names.split(",")}
    assert [name for name in BY_NAME if name not in said and name != "plain"] == []
    for name, condition in BY_NAME.items():
        if name not in ("plain", "float16"):
            assert said[name].startswith(f"{condition.allowed:g}"), name


def test_the_plain_run_comes_first_whatever_is_asked_for() -> None:
    assert select([]) == list(CONDITIONS)
    assert [c.name for c in select(["inside", "all-white"])] == ["plain", "all-white", "inside"]
    assert select(["plain"]) == [PLAIN]
    with pytest.raises(ConfigError, match=r"--only: there is no condition 'all-whit'\. Did you mean 'all-white'"):
        select(["all-whit"])


@pytest.mark.parametrize("condition", CONDITIONS, ids=lambda condition: condition.name)
def test_each_makes_a_scene_that_hangs_together(condition: Condition) -> None:
    views = condition.change(BALL)
    for dataset in (views.train, views.test):
        assert len(dataset.pixels) == int(dataset.cameras.offsets[-1])
        assert len(dataset.names) == dataset.scene.num_cameras == len(dataset)
        assert dataset.scene.has_alpha == (dataset.pixels.shape[1] == 4)
        assert 0 < dataset.scene.near < dataset.scene.far
        assert bool((dataset.scene.box[1] > dataset.scene.box[0]).all())
    finite = bool(torch.isfinite(views.train.cameras.camera_to_worlds).all())
    assert finite == (condition.name != "nan-pose")
    assert bool(torch.isfinite(views.test.cameras.camera_to_worlds).all())


@pytest.mark.parametrize("condition", CONDITIONS, ids=lambda condition: condition.name)
def test_each_has_settings_that_are_accepted_or_refused(condition: Condition) -> None:
    config = replace(load_method("instant-ngp").config, learning_rate=0.01)  # as `shortened` fills it in
    if condition.name == "float16":
        with pytest.raises(ConfigError, match="'mixed_precision' is 'float16'; it must be bool"):
            from_plain(config, condition.settings(config), condition.name)
        return
    changed = from_plain(config, condition.settings(config), condition.name)
    if condition.name == "learning-rate-x10":
        assert changed.learning_rate == pytest.approx(10 * config.learning_rate)
    elif condition.name == "bfloat16":
        assert changed.mixed_precision is True
    elif condition.name == "float32":
        assert changed.mixed_precision is False
    elif condition.name == "1-ray":
        assert replace(changed, train_rays_per_pixel_from=config.train_rays_per_pixel_from) == config
    elif condition.name == "another-seed":
        assert changed.machine.seed == config.machine.seed + 1
        assert replace(changed, machine=config.machine) == config
    else:
        assert changed == config


def test_short_runs_take_small_steps() -> None:
    for method in ("vanilla-nerf", "instant-ngp"):
        loaded = load_method(method)
        config = shortened(loaded.config, Budget(7, 1.5), loaded, BALL.train.scene)
        assert (config.max_num_iterations, config.max_seconds, config.vis) == (7, 1.5, "none")
        assert config.num_rays_per_batch == MAX_RAYS
        assert config.learning_rate == (5e-4 if method == "vanilla-nerf" else 0.02)  # in 1.5 s
        assert config.samples_per_batch == (None if method == "vanilla-nerf" else MAX_SAMPLES)


def stressed(run: Run, condition: Condition) -> Trainer:
    """A trainer on the ball with batches under the condition."""
    create_folder(run)
    source = StressedSource(make_source("pixels", BALL.train, run.config), condition)
    return Trainer(load_method(run.method), run.config, BALL.train, source=source)


@pytest.mark.parametrize(("name", "rays"), [("1-ray", 1), ("8192-rays", 8192)])
def test_a_step_has_so_many_rays(name: str, rays: int, tmp_path: Path) -> None:
    """This includes a method with rays that follow its samples, and four rays through a pixel."""
    run, condition = tiny_run("instant-ngp", Path("none"), tmp_path, train_rays_per_pixel_from=0.0), BY_NAME[name]
    trainer = stressed(replace(run, config=from_plain(run.config, condition.settings(run.config), name)), condition)
    trainer.train_step()
    assert trainer.state.rays == rays


def test_spoiled_batches_are_dropped_and_counted(tmp_path: Path) -> None:
    trainer = stressed(tiny_run("instant-ngp", Path("none"), tmp_path), BY_NAME["nan-pixels"])
    for _ in range(6):
        trainer.train_step()
    assert trainer.state.skipped == 2
    assert math.isfinite(trainer.state.train_mse)
