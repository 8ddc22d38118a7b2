"""Clocks that are set while a run trains: time spent is counted by one that nobody sets, and nothing else is by any."""

import ast
import os
import time
from dataclasses import replace
from datetime import datetime, tzinfo
from itertools import cycle
from pathlib import Path

import pytest

from nerfloom.base.errors import ConfigError
from nerfloom.cli.session import start
from nerfloom.training.checkpoint import FOLDER, list_checkpoints, load_newest
from nerfloom.training.report import SUMMARY
from nerfloom.training.run import run_folder
from tests.conftest import TICK
from tests.training.helpers import tiny_run, tiny_trainer

ROOT = Path(__file__).parents[2]
DAY = 86_400.0


@pytest.fixture
def jumps(monkeypatch: pytest.MonkeyPatch) -> None:
    """A wall clock that somebody sets a day back, two days on, and so forth, each time that it is looked at."""
    true_time, days = time.time, cycle((-DAY, DAY, -400 * DAY, 0.0))
    monkeypatch.setattr(time, "time", lambda: true_time() + next(days))


@pytest.mark.usefixtures("jumps", "even_clock")
def test_a_clock_that_is_set_is_not_trained_by(shared_tiny: Path, tmp_path: Path) -> None:
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run", max_seconds=0.3, seconds_per_save=0.06)
    spent = []
    original = trainer.train_step

    def step() -> object:
        report = original()
        spent.append(report.seconds)
        return report

    trainer.train_step = step  # type: ignore[method-assign,assignment]
    assert trainer.train().reason == "0.3 s of training spent"
    assert spent == sorted(spent)
    assert 0.3 <= spent[-1] < 0.3 + 2 * TICK
    assert len(list_checkpoints(trainer.checkpoint_folder)) == 2


@pytest.mark.medium
def test_the_wall_clock_is_asked_for_nothing() -> None:
    """It names folders, and tells people when a report was made; all measurements use `perf_counter`."""
    files = [file for folder in ("framework", "methods", "dataparsers") for file in (ROOT / folder).rglob("*.py")]
    assert len(files) > 30
    for file in files:
        text = file.read_text(encoding="utf-8")
        for node in ast.walk(ast.parse(text)) if "time.time" in text else ():
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "time":
                assert node.attr not in ("time", "time_ns"), f"{file}:{node.lineno}"


def test_the_newest_checkpoint_is_that_of_the_most_steps_whatever_its_date(shared_tiny: Path, tmp_path: Path) -> None:
    settings = {"max_num_iterations": 4, "steps_per_save": 2, "max_eval_images": 0}
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run", **settings)
    trainer.train()
    for age, path in enumerate(list_checkpoints(trainer.checkpoint_folder)):
        os.utime(path, (10**9 - age * DAY, 10**9 - age * DAY))
    newest = load_newest(trainer.checkpoint_folder)
    assert newest is not None
    assert newest["state"]["step"] == 4


def test_a_time_that_comes_twice_names_no_folder_twice(
    shared_tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After the clock was set back, in autumn, or of two runs that begin at once."""

    class Stopped(datetime):
        @classmethod
        def now(cls, tz: tzinfo | None = None) -> "Stopped":
            return cls(2026, 10, 25, 2, 30)

    monkeypatch.setattr("nerfloom.training.run.datetime", Stopped)
    settings = {"output_dir": tmp_path, "timestamp": None, "max_num_iterations": 1, "max_eval_images": 0}
    a_run = tiny_run("instant-ngp", shared_tiny, tmp_path, **settings)
    first, second = (replace(a_run, folder=run_folder(a_run.method, a_run.config)) for _ in range(2))
    assert first.folder == second.folder
    assert start(first).folder == first.folder
    before = {path: path.read_bytes() for path in first.folder.rglob("*") if path.is_file()}
    other = start(second)
    assert [path.name for path in (first.folder, other.folder)] == ["2026-10-25_023000", "2026-10-25_023001"]
    for run in (first, other):
        assert len(list_checkpoints(run.folder / FOLDER)) == 1
        assert (run.folder / SUMMARY).is_file()
    named = replace(a_run.config, timestamp=first.folder.name)
    with pytest.raises(ConfigError, match="already holds a run"):
        start(replace(first, config=named))
    assert {path: path.read_bytes() for path in before} == before
