"""A comparison's figures and rules: the best run is named best, and repeats have other seeds."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from nerfloom.cli.train import run_of
from nerfloom.comparison.measures import Measured, measure, rows_of
from nerfloom.comparison.plan import Contender, PlannedRun
from nerfloom.comparison.report import COLUMNS, table
from tests.comparison.runs import CONDITIONS, finish, plan

BETTER = {
    "PSNR, dB": 31.0, "SSIM": 0.95, "MS-SSIM": 0.98, "LPIPS (alex)": 0.05, "floaters, %": 1.0, "training, s": 50.0,
    "Chamfer, % of side": 0.1, "F-score, %": 90.0, "normals, °": 5.0, "faces": 900, "normals of views, °": 6.0,
    "diffuse PSNR, dB": 25.0,
    "steps": 2000, "training, rays/s": 3e5, "rendering, s/image": 0.2, "peak memory, GiB": 2**29, "parameters": 1000,
}  # fmt: skip
"""Better values of each column, from the meaning of the metric, not from the report."""
WORSE = {
    "PSNR, dB": 30.0, "SSIM": 0.9, "MS-SSIM": 0.93, "LPIPS (alex)": 0.1, "floaters, %": 2.0, "training, s": 60.0,
    "Chamfer, % of side": 0.2, "F-score, %": 80.0, "normals, °": 9.0, "faces": 100, "normals of views, °": 8.0,
    "diffuse PSNR, dB": 20.0,
    "steps": 1000, "training, rays/s": 1e5, "rendering, s/image": 0.4, "peak memory, GiB": 2**30, "parameters": 9000,
}  # fmt: skip

NEITHER = ("steps", "training, rays/s", "faces")
"""Columns without a best: a method may learn more in fewer steps, rays of one that draws images are pixels, and more
faces are not a merit."""


def finished(planned: PlannedRun, figures: dict[str, float]) -> Measured:
    """A run with such figures, read back from its files."""
    changes = {
        "steps": figures["steps"],
        "rays_per_second": figures["training, rays/s"],
        "peak_memory_bytes": figures["peak memory, GiB"],
        "parameters": figures["parameters"],
    }
    finish(planned, figures["PSNR, dB"], figures["training, s"], **changes)
    evaluation = json.loads(planned.evaluation.read_text())
    evaluation["results"] |= {
        "ssim": figures["SSIM"],
        "ms_ssim": figures["MS-SSIM"],
        "lpips": figures["LPIPS (alex)"],
        "floaters": figures["floaters, %"],
        "normal_mae": figures["normals of views, °"],
        "diffuse_psnr": figures["diffuse PSNR, dB"],
        "fps": 1 / figures["rendering, s/image"],
    }
    evaluation["geometry"] = {
        "chamfer_percent": figures["Chamfer, % of side"],
        "f_scores": [{"f_score": figures["F-score, %"] / 100}],
        "normals": {"degrees": figures["normals, °"]},
        "faces": figures["faces"],
    }
    planned.evaluation.write_text(json.dumps(evaluation))
    found = measure(planned, CONDITIONS)
    assert found is not None
    return found


def test_the_better_figure_of_every_column_is_called_the_best(tmp_path: Path) -> None:
    assert {column.title for column in COLUMNS} == set(BETTER)
    labels = ("tensorf", "kplanes")
    all_planned = plan(tmp_path, *labels).runs()
    runs = [finished(planned, figures) for planned, figures in zip(all_planned, (WORSE, BETTER), strict=True)]
    worse, better = table(rows_of(labels, runs, {}))
    for column, bad, good in zip(COLUMNS, worse["cells"], better["cells"], strict=True):
        assert (bad.best, good.best) == (False, column.title not in NEITHER), column.title
    assert (worse["front"], better["front"]) == (False, True)
    shown = {column.title: cell.text for column, cell in zip(COLUMNS, better["cells"], strict=True)}
    assert shown["rendering, s/image"] == "0.20"
    assert shown["peak memory, GiB"] == "0.50"


def test_repeats_are_runs_of_other_seeds_in_other_folders(tmp_path: Path) -> None:
    """ns-train itself parses the commands."""
    all_planned = plan(tmp_path, "kplanes", "instant-ngp --num-levels 3", repeats=3).runs()
    runs = [run_of(*_method_and_flags(planned)) for planned in all_planned]
    assert [run.config.machine.seed for run in runs] == [42, 42, 43, 43, 44, 44]
    assert [run.folder for run in runs] == [planned.folder for planned in all_planned]
    assert len({run.folder for run in runs}) == 6
    assert {run.config.max_seconds for run in runs} == {60.0}
    assert {run.config.max_eval_images for run in runs} == {4}
    assert [getattr(run.config, "num_levels", None) for run in runs[:2]] == [None, 3]


def test_what_a_contender_says_itself_counts(tmp_path: Path) -> None:
    planned = PlannedRun(Contender.of("kplanes --max-seconds 7 --machine.seed 3"), 42, tmp_path)
    config = run_of(*_method_and_flags(planned)).config
    assert (config.max_seconds, config.machine.seed) == (7.0, 3)


@pytest.mark.parametrize(("views", "flags"), [(None, []), (5, ["--max-images", "5"])])
def test_all_views_are_judged_unless_some_are_asked_for(views: int | None, flags: list[str], tmp_path: Path) -> None:
    """How many the learning curve is over says nothing about it."""
    words = PlannedRun(Contender.of("kplanes"), 42, tmp_path).eval_command(replace(CONDITIONS, max_eval_images=views))
    assert words[len(words) - len(flags) :] == flags
    assert ("--max-images" in words) == bool(flags)


def _method_and_flags(planned: PlannedRun) -> tuple[str, list[str]]:
    words = planned.train_command(CONDITIONS)
    at = words.index(planned.contender.method)
    return words[at], words[at + 1 :]
