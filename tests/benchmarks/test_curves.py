"""PSNR against seconds of training: the runs, the kept results, and the output."""

import json
from pathlib import Path
from statistics import fmean, stdev

import pytest

from benchmarks import curves
from benchmarks.__main__ import main
from nerfloom.base.errors import ConfigError
from nerfloom.comparison.plan import Contender, PlannedRun
from nerfloom.jobs.processes import Processes
from nerfloom.registry import registered
from tests.comparison.runs import at_once, finish
from tests.conftest import Refused

METHODS = ("instant-ngp", "kplanes --num-scales 2")


def psnr_of(planned: PlannedRun, seconds: float) -> float:
    """A PSNR that differs between methods, budgets and seeds."""
    return 20 + len(planned.contender.label) / 10 + seconds / 100 + (planned.seed - 42) ** 2 / 4


@pytest.fixture
def ran(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, float, int]]:
    """Runs that were asked for: label, seconds and seed of each; they end at once, with the PSNR of `psnr_of`."""
    asked: list[tuple[str, float, int]] = []

    def outcome(planned: PlannedRun, seconds: float) -> str | None:
        asked.append((planned.contender.label, seconds, planned.seed))
        if "nerfacto" in planned.contender.label:
            return "its GPU is on fire"
        finish(planned, psnr_of(planned, seconds), seconds + 0.5)
        return None

    monkeypatch.setattr(Processes, "run", at_once(outcome))
    return asked


def test_every_registered_method_is_run_if_none_is_named(tmp_path: Path) -> None:
    (plan,) = curves.plans((), None, (10.0,), 1, 50, tmp_path)
    assert {contender.method for contender in plan.contenders} == set(registered("methods"))


def test_each_budget_is_a_run_of_its_own_without_curve_images(tmp_path: Path) -> None:
    first, second = curves.plans(METHODS, tmp_path, (45.0, 10.0, 45.0), 2, 30, tmp_path / "runs")
    assert [first.conditions.max_seconds, second.conditions.max_seconds] == [10.0, 45.0]
    assert first.folder != second.folder
    planned = first.runs()[0]
    words = planned.train_command(first.conditions)
    assert words[words.index("--max-seconds") + 1] == "10.0"
    assert words[words.index("--max-eval-images") + 1] == "0"  # which would only take time
    assert "--seconds-per-eval-all-images" not in words
    assert planned.eval_command(first.conditions)[-2:] == ["--max-images", "30"]
    with pytest.raises(ConfigError, match="--budgets is empty"):
        curves.plans(METHODS, None, (), 1, 50, tmp_path)


def test_means_and_spreads_over_the_seeds(ran: list[tuple[str, float, int]], tmp_path: Path) -> None:
    plans = curves.plans(METHODS, None, (10.0, 45.0), 3, 16, tmp_path)
    found = [curves.run(plan) for plan in plans]
    content = curves.published(plans[-1], found)
    assert [method["method"] for method in content["methods"]] == list(METHODS)
    for label, method in zip(METHODS, content["methods"], strict=True):
        for seconds, point in zip((10.0, 45.0), method["points"], strict=True):
            psnrs = [psnr_of(PlannedRun(Contender.of(label), seed, tmp_path), seconds) for seed in (42, 43, 44)]
            assert point["budget, s"] == seconds
            assert point["training, s"] == seconds + 0.5
            assert point["PSNR, dB"] == pytest.approx(fmean(psnrs), abs=1e-3)
            assert point["standard deviation of a run, dB"] == pytest.approx(stdev(psnrs), abs=1e-3)
            assert list(point["PSNR of each seed, dB"].values()) == pytest.approx(psnrs, abs=1e-3)
    assert content["held-out views"] == [16]
    assert len(content["machines"]) == 1
    assert str(tmp_path) not in json.dumps(content)


def test_what_was_run_is_kept(ran: list[tuple[str, float, int]], tmp_path: Path) -> None:
    for methods, budgets, seeds in ((METHODS[:1], (10.0,), 1), (METHODS[:1], (10.0, 45.0), 2), (METHODS, (45.0,), 2)):
        for plan in curves.plans(methods, None, budgets, seeds, 50, tmp_path):
            curves.run(plan)
    one, other = METHODS
    assert ran[:1] == [(one, 10.0, 42)]
    assert ran[1:4] == [(one, 10.0, 43), (one, 45.0, 42), (one, 45.0, 43)]
    assert ran[4:] == [(other, 45.0, 42), (other, 45.0, 43)]
    (plan,) = curves.plans(METHODS, None, (10.0,), 1, 25, tmp_path)
    with pytest.raises(ConfigError, match="max_eval_images 50, not 25"):
        curves.run(plan)


@pytest.mark.medium
def test_the_command_writes_json_and_a_picture_and_names_failures(
    ran: list[tuple[str, float, int]], tmp_path: Path, refused: Refused
) -> None:
    pytest.importorskip("matplotlib")
    folders = ("--run-dir", tmp_path / "runs", "--output-dir", tmp_path, "--plot-dir", tmp_path)
    flags = ("--methods", "instant-ngp", "nerfacto", "--budgets", 10, 45, "--seeds", 2, *folders)
    assert "runs of these methods failed: nerfacto" in refused(main, "curves", *flags)
    content = json.loads((tmp_path / "curves-procedural.json").read_text())
    good, failed = (method["points"] for method in content["methods"])
    assert [point["PSNR, dB"] is not None for point in good] == [True, True]
    assert failed[0]["PSNR, dB"] is None
    assert failed[0]["failures"] == ["seed 42: its GPU is on fire", "seed 43: its GPU is on fire"]
    picture = (tmp_path / "curves-procedural.svg").read_text()
    assert picture.startswith("<svg")
    assert "<!-- instant-ngp -->" in picture
    assert "<!-- PSNR, dB -->" in picture
