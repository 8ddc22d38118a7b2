"""ns-bench and python -m benchmarks: each is listed, has help and runs, and refuses bad input in one line."""

import json
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest
import torch

from benchmarks import __main__ as ours
from nerfloom.cli import bench
from tests.cli.helpers import benchmarked, called
from tests.conftest import Refused


@pytest.mark.parametrize("module", [bench, ours], ids=["ns-bench", "benchmarks"])
def test_help_lists_every_benchmark_in_a_line_without_torch(module: ModuleType) -> None:
    shown = f"from {module.__name__} import main; sys.argv[1:] = ['--help']; main()"
    code = f"import atexit, sys; atexit.register(lambda: print('torch' in sys.modules)); {shown}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    *lines, torch_is_loaded = done.stdout.splitlines()
    assert torch_is_loaded == "False"
    assert lines[: len(module.USAGE.splitlines())] == module.USAGE.splitlines()
    listed = [line.split()[0] for line in lines if line.startswith("  ")]
    assert listed == list(module.KINDS)
    assert all(len(line) <= 120 for line in lines)


@pytest.mark.parametrize("name", [*bench.KINDS, *ours.KINDS])
def test_every_benchmark_shows_its_flags(name: str) -> None:
    done = called("ns-bench", name, "--help") if name in bench.KINDS else benchmarked(name, "--help")
    assert done.returncode == 0
    named = {"contention", "cache", "meshes", "operations", "frames"}
    flags = {"poses": "--processed", "city": "--results"} | dict.fromkeys(named, "--output")
    assert flags.get(name, "--output-dir") in done.stdout


def test_bad_input_is_refused_in_a_line(shared_tiny: Path, tmp_path: Path, refused: Refused) -> None:
    output = ("--output", tmp_path / "c.json")
    assert "there is no benchmark 'contenton'. Did you mean 'contention'?" in refused(ours.main, "contenton")
    assert "no such folder" in refused(ours.main, "contention", "--data", tmp_path / "none", *output)
    assert "there is no condition 'loop3'" in refused(
        ours.main, "contention", "--data", shared_tiny, "--rows", "loop3", *output, status=2
    )
    in_a_file = ("--output-dir", shared_tiny / "transforms_train.json" / "below")
    assert "cannot write" in refused(ours.main, "processes", "--data", shared_tiny, *in_a_file)
    nothing = ("--data", shared_tiny, "--method", " ", "--output-dir", tmp_path)
    assert "--method: ' ' names no method; give one" in refused(bench.main, "profile-step", *nothing, status=2)
    asked = ("--method", "instant-ngp", "--output-dir", tmp_path)
    assert "has no --camera-optimizer" in refused(ours.main, "pose-refinement", *asked)


@pytest.mark.slow  # hundreds of steps of a whole instant-ngp
def test_a_profile_adds_up(shared_tiny: Path, tmp_path: Path) -> None:
    method = "nerfacto --sampler proposal --num-rays-per-batch 128"
    flags = ("--data", shared_tiny, "--method", method, "--steps", 2, "--output-dir", tmp_path)
    done = called("ns-bench", "profile-step", *flags)
    assert done.returncode == 0, done.stderr
    content = json.loads((tmp_path / "profile-step.json").read_text())["rows"][method]
    assert content["rays per step"] == 128
    assert sum(content["ms"].values()) == pytest.approx(content["ms per step"], abs=0.1)
    assert content["ms"]["the GPU waits" if torch.cuda.is_available() else "Python and torch"] > 0


@pytest.mark.slow  # four processes of their own
def test_contention_is_measured_alone_and_beside(shared_tiny: Path, tmp_path: Path) -> None:
    flags = ["--data", shared_tiny, "--rows", "one loop", "--seconds", 0.3, "--work", "training"]
    done = benchmarked("contention", *flags, "--output", tmp_path / "c.json")
    assert done.returncode == 0, done.stderr
    (content,) = json.loads((tmp_path / "c.json").read_text())["rows"].values()
    rows = content["training"]
    assert [row["beside"] for row in rows] == ["nothing", "one loop", "one loop, OMP_WAIT_POLICY=PASSIVE"]
    assert rows[0]["share"] == [1.0]
    for row in rows:
        assert row["a second"][0] > 0
        assert row["longest, s"][0] + 0.001 > row["median, s"][0] > 0  # they are rounded


@pytest.mark.slow  # three processes of their own
def test_the_cache_is_measured(tmp_path: Path) -> None:
    size = ["--images", 4, "--width", 160, "--height", 96, "--limit", 0.1, "--seconds", 1]
    done = benchmarked("cache", *size, "--folder", tmp_path, "--output", tmp_path / "out" / "c.json")
    assert done.returncode == 0, done.stderr
    content = json.loads((tmp_path / "out" / "c.json").read_text())
    assert content["large, from a file"]["pixels MB"] == pytest.approx(4 * 160 * 96 * 3 / 1e6, abs=0.05)
    assert content["small, in memory"]["share of time waiting for pixels"] == 0
    assert content["large, from a file"]["share of time waiting for pixels"] > 0
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
