"""Whole runs under conditions: a small instant-ngp, a plugin that breaks, and the command."""

import json
import math
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from nerfloom import ConfigError, registry
from nerfloom.cli.stress import main
from nerfloom.stress.conditions import CONDITIONS, PLAIN, select
from nerfloom.stress.scenes import ball_views
from nerfloom.stress.trial import Budget, attempt, unsound
from nerfloom.stress.verdict import verdicts
from nerfloom.training.trainer import Trainer
from tests.cli.helpers import TINY_NGP
from tests.conftest import Refused
from tests.training.helpers import TINY, tiny_run, tiny_trainer

BALL = ball_views()
BUDGET = Budget(steps=75, seconds=None)
SICK = " ".join(["sick", *TINY_NGP])
WITHOUT_ALPHA = {"gaussian-splatting": {"start": "auto"}, "moving-gaussians": {"start": "auto"}}
"""Settings of tiny runs that suit images without alpha too, which some conditions have."""


@pytest.mark.medium
def test_a_small_method_in_easy_hard_scenes(tmp_path: Path) -> None:
    run = tiny_run("instant-ngp", Path("none"), tmp_path)
    found = {v.name: v for v in verdicts(run, BALL, select(["all-black", "duplicate-cameras", "nan-pixels"]), BUDGET)}
    for verdict in found.values():
        print(verdict.name, verdict.line())
    assert list(found) == ["plain", "all-black", "duplicate-cameras", "nan-pixels"]
    assert found["plain"].outcome == "pass"
    assert found["plain"].lost == 0
    assert {v.outcome for v in found.values()} <= {"pass", "degraded"}
    assert all(v.psnr is not None and v.psnr > 10 for v in found.values())
    assert all(v.steps == 75 for v in found.values())
    assert found["nan-pixels"].skipped == 25
    assert found["duplicate-cameras"].skipped == 0
    assert list(tmp_path.iterdir()) == []  # the run's own folder is not used


def test_what_the_framework_does_not_offer_is_refused(tmp_path: Path) -> None:
    run = tiny_run("instant-ngp", Path("none"), tmp_path)
    _, verdict = verdicts(run, BALL, select(["float16"]), Budget(1, None))
    assert verdict.outcome == "refused"
    assert verdict.error == "float16: 'mixed_precision' is 'float16'; it must be bool"


def test_rays_a_step_say_nothing_of_what_draws_images(tmp_path: Path) -> None:
    run = tiny_run("gaussian-splatting", Path("none"), tmp_path)
    one, many = list(verdicts(run, BALL, select(["1-ray", "8192-rays"]), Budget(1, None)))[1:]
    assert one.outcome == many.outcome == "not applicable"
    assert one.cell() == "not applicable"
    assert one.reason == "a step draws a whole image"


@pytest.mark.medium
def test_the_same_run_twice_is_the_same(tmp_path: Path) -> None:
    run = tiny_run("instant-ngp", Path("none"), tmp_path)
    first, second = (attempt(PLAIN, run, BALL, Budget(20, None)) for _ in range(2))
    assert first.psnr == second.psnr
    assert first.error is None


def test_batches_are_those_of_the_decided_settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Such as --robust, which is decided from the images."""
    known = list[bool]()

    def decided(config: Any, dataset: object) -> tuple[Any, list[Any]]:
        return replace(config, robust="errors"), []

    def train(trainer: Trainer) -> None:
        known.append(trainer.source.contradicted is not None)
        raise ConfigError("seen")

    monkeypatch.setattr("nerfloom.training.preparation.robust_chosen", decided)
    monkeypatch.setattr(Trainer, "train", train)
    found = attempt(PLAIN, tiny_run("instant-ngp", Path("none"), tmp_path), BALL, Budget(1, None))
    assert found.error == "seen"
    assert known == [True]


def test_what_is_not_finite_is_named(shared_tiny: Path, tmp_path: Path) -> None:
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run")
    trainer.train_step()
    assert unsound(trainer, BALL.test) is None
    kept, trainer.state.train_mse = trainer.state.train_mse, math.nan
    assert unsound(trainer, BALL.test) == "the running mean of the training error is not finite"
    trainer.state.train_mse = kept
    with torch.no_grad():
        trainer.model.field.color_head[0].weight[0, 0] = math.inf
    assert unsound(trainer, BALL.test) == "the parameter field.color_head.0.weight is not finite"


# -- a plugin that breaks, and the command ------------------------------------------------------------------------


@pytest.fixture
def sick(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Registered as a plugin: instant-ngp that shows NaN in batches of few rays."""
    monkeypatch.setenv("NERFLOOM_METHODS", "sick=tests.stress_command.sick:METHOD")
    registry.registered.cache_clear()
    yield
    registry.registered.cache_clear()


def stress(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> None:
    monkeypatch.setattr(sys, "argv", ["ns-stress", *map(str, arguments)])
    main()


@pytest.mark.medium
@pytest.mark.usefixtures("sick")
def test_a_plugin_that_is_sick_once_fails_there_and_the_rest_goes_on(tmp_path: Path, refused: Refused) -> None:
    path = tmp_path / "out" / "sick.json"
    flags = ("--only", "1-ray", "duplicate-cameras", "nan-pixels", "--max-num-iterations", 40, "--output-path", path)
    assert refused(main, SICK, *flags).endswith(f"1 of 4 runs failed: {SICK}: 1-ray")
    content = json.loads(path.read_text())
    assert content["data"] == "ball"
    assert content["max_num_iterations"] == 40
    assert content["conditions"]["1-ray"] == {"what": "one ray a step", "allowed": 2.0}
    (found,) = content["methods"]
    assert found["method"] == SICK
    assert {"torch", "commit", "threads", "kernels"} <= set(found["machine"])
    assert found["settings"]["num_levels"] == 4
    assert found["settings"]["max_num_iterations"] == 40
    outcomes = {verdict["name"]: verdict for verdict in found["verdicts"]}
    assert list(outcomes) == ["plain", "duplicate-cameras", "1-ray", "nan-pixels"]
    assert "10 steps in a row were not finite" in outcomes["1-ray"]["error"]
    assert "/" not in outcomes["1-ray"]["error"].replace("the run's folder/nerfstudio_models", "")
    for name in ("plain", "duplicate-cameras", "nan-pixels"):
        assert outcomes[name]["outcome"] in ("pass", "degraded")
        assert outcomes[name]["psnr"] is not None


@pytest.mark.usefixtures("sick")
def test_a_plugin_that_is_always_sick_fails_everywhere(tmp_path: Path, refused: Refused) -> None:
    path = tmp_path / "sick.json"
    flags = ("--only", "all-white", "--max-num-iterations", 20, "--output-path", path)
    method = f"{SICK} --sick-rays 999999999"
    assert f"2 of 2 runs failed: {method}: plain, {method}: all-white" in refused(main, method, *flags)
    for verdict in json.loads(path.read_text())["methods"][0]["verdicts"]:
        assert verdict["outcome"] == "fail"
        assert verdict["psnr"] is None
        assert verdict["lost"] is None


@pytest.mark.medium
@pytest.mark.usefixtures("sick")
def test_several_methods_make_one_table(tmp_path: Path, refused: Refused) -> None:
    """A row for each condition, a column for each method, and the reason for each outcome other than a pass."""
    path = tmp_path / "both.json"
    flags = ("--only", "1-ray", "--max-num-iterations", 15, "--output-path", path)
    healthy = " ".join(["instant-ngp", *TINY_NGP])
    assert f"1 of 4 runs failed: {SICK}: 1-ray" in refused(main, healthy, SICK, *flags)
    found = json.loads(path.read_text())["methods"]
    assert [method["method"] for method in found] == [healthy, SICK]
    assert [[verdict["name"] for verdict in method["verdicts"]] for method in found] == [["plain", "1-ray"]] * 2
    lines = path.with_suffix(".md").read_text().splitlines()
    assert lines[0] == f"| condition | {healthy} | {SICK} |"
    assert lines[3].startswith("| 1-ray | ")
    assert lines[3].endswith(" | fail |")
    assert any(line.startswith(f"- {SICK}, 1-ray: fail: ") for line in lines)


def test_all_stands_for_every_registered_method(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []
    monkeypatch.setattr("nerfloom.cli.stress.stress", lambda methods, flags: asked.extend(methods) or [])
    stress(monkeypatch, "all", "--only", "plain")
    assert asked == list(registry.registered("methods"))
    assert "instant-ngp" in asked


def test_photographs_for_one_method_alone_are_refused(shared_tiny: Path, refused: Refused) -> None:
    assert "put --data after the methods" in refused(main, f"instant-ngp --data {shared_tiny}")


@pytest.mark.medium
def test_on_somebodys_data(
    shared_tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "ball.json"
    only = ("--only", "inside", "one-image")
    method = " ".join(["instant-ngp", *TINY_NGP])
    stress(monkeypatch, method, "--data", shared_tiny, *only, "--max-num-iterations", 15, "--output-path", path)
    said = capsys.readouterr().err
    assert "pictures of the ball: inside" in said
    content = json.loads(path.read_text())
    assert content["data"] == "ball"  # the folder's name
    assert [verdict["name"] for verdict in content["methods"][0]["verdicts"]] == ["plain", "one-image"]
    assert str(shared_tiny) not in path.read_text() + path.with_suffix(".md").read_text()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("instant-npg",), "unknown method 'instant-npg'. Did you mean 'instant-ngp'"),
        (("instant-ngp", "--only", "all-whit"), "Did you mean 'all-white'"),
        (("instant-ngp", "--data", "/no/such/folder"), "there is no such folder"),
        (("instant-ngp 'open",), 'METHOD: "instant-ngp \'open" is invalid'),
        (("instant-ngp", "--max-num-iterations", 0), "--max-num-iterations must be at least 1"),
        (("instant-ngp", "--output-path", "table.md"), "--output-path table.md: it must end in .json"),
        (("instant-ngp", "kplanez"), "unknown method 'kplanez'. Did you mean 'kplanes'"),
        (("--data",), "the methods come first, before --data"),
        (("",), "METHOD: '' names no method"),
    ],
)
def test_what_cannot_be_begun_is_one_line(
    arguments: tuple[object, ...], words: str, refused: Refused, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    flags = {"", "--only", "--max-num-iterations", "--output-path"}
    assert words in refused(main, *arguments, status=2 if flags & set(arguments) else 1)
    assert list(tmp_path.iterdir()) == []


def test_a_place_that_cannot_be_written_is_named_before_anything_is_trained(
    tmp_path: Path, refused: Refused, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("nerfloom.stress.verdict.verdicts", None)
    (tmp_path / "file").touch()
    said = refused(main, "instant-ngp", "--output-path", tmp_path / "file" / "table.json")
    assert f"cannot write {tmp_path / 'file' / 'table.json'}: Not a directory; name another place" in said


def test_help_without_a_method(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    stress(monkeypatch, "--help")
    assert "usage: ns-stress METHOD" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize("kind", [kind for kind in TINY if "+" not in kind])
def test_no_built_in_method_fails_under_any_condition(kind: str, tmp_path: Path) -> None:
    run = tiny_run(kind, Path("none"), tmp_path, **WITHOUT_ALPHA.get(kind, {}))
    found = list(verdicts(run, BALL, CONDITIONS, Budget(200, 30.0)))
    for verdict in found:
        print(f"{kind:14}{verdict.name:20}{verdict.line()}")
    assert [f"{verdict.name}: {verdict.error}" for verdict in found if verdict.outcome == "fail"] == []
