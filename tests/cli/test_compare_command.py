"""ns-compare from outside."""

import json
import shutil
from pathlib import Path

import pytest

from tests.cli.helpers import called, run

SMALL = "--num-levels 4 --max-resolution 64 --log2-table-size 12 --grid-resolution 16 --num-steps 64"
PLANES = "--base-resolution 16 --num-scales 2 --features-per-scale 8 --grid-resolution 16 --num-steps 64"
NGP, KPLANES = f"instant-ngp {SMALL} --samples-per-batch 4096", f"kplanes {PLANES} --samples-per-batch 4096"


@pytest.mark.slow
def test_two_methods_one_that_fails_and_a_second_call(shared_tiny: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    flags = ("--data", shared_tiny, "--max-num-iterations", 24, "--output-dir", out, "--curve-images", 1)
    broken = "tensorf --first-voxels -5"
    done = run("ns-compare", "--methods", NGP, KPLANES, broken, *flags)
    assert done.returncode == 1
    assert "failed: tensorf --first-voxels -5" in done.stderr
    content = json.loads((out / "results.json").read_text())
    assert [run["method"] for run in content["runs"]] == ["instant-ngp", "kplanes"]
    for measured in content["runs"]:
        assert measured["steps"] == 24
        assert measured["psnr"] > 5
        assert len(measured["curve"]) == 8
        assert measured["parameters"] > 0
        assert measured["machine"]["torch"]
    assert "voxels" in content["failures"][broken][0]
    assert (out / "report.html").stat().st_size > 20_000
    before = {path: path.stat().st_mtime_ns for path in (out / "runs").rglob("*.ckpt")}
    shutil.rmtree(out / "runs" / content["runs"][1]["folder"].split("/")[-3])
    again = run("ns-compare", "--methods", NGP, KPLANES, *flags)
    assert again.returncode == 0, again.stderr
    assert "[1/2]" in again.stderr
    assert again.stderr.count("already finished") == 1
    kept = {path: when for path, when in before.items() if "instant-ngp" in str(path)}
    assert kept
    assert all(path.stat().st_mtime_ns == when for path, when in kept.items())
    other = run("ns-compare", "--methods", NGP, "--data", shared_tiny, "--max-seconds", 5, "--output-dir", out)
    assert other.returncode == 1
    assert "has a comparison under other conditions" in other.stderr


@pytest.mark.parametrize(
    ("flags", "status", "reason"),
    [
        (("--methods", "kplanes"), 2, "set the training budget"),
        (("--max-seconds", 1), 2, "--methods is empty"),
        (("--methods", "kplanez", "--max-seconds", 1), 1, "Did you mean 'kplanes'"),
        (("--methods", "kplanes", "--max-seconds", 1, "--data", "/no/such/folder"), 1, "there is no such folder"),
        (("--load-config",), 2, "--load-config needs a path"),
    ],
)
def test_what_cannot_be_compared(flags: tuple[object, ...], status: int, reason: str, tmp_path: Path) -> None:
    done = called("ns-compare", *flags, folder=tmp_path)
    assert done.returncode == status
    assert reason in done.stderr.replace("\n", " ")
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    "recipe", sorted((Path(__file__).parents[2] / "configs").glob("compare-*.yml")), ids=lambda path: path.name
)
def test_the_standard_comparisons_are_readable(recipe: Path) -> None:
    from nerfloom.base.plain import from_plain, read_yaml
    from nerfloom.cli.compare import CompareFlags, plan_of

    plan = plan_of(from_plain(CompareFlags(), read_yaml(recipe), str(recipe)))
    assert len(plan.runs()) >= 3
