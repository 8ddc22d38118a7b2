"""Methods of new kinds are trained by the unchanged trainer, evaluated and rendered by the unchanged commands."""

import dataclasses
import functools
import json
from collections.abc import Callable
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest

import nerfloom
from nerfloom.registry import load_method
from nerfloom.testing import check_method
from tests.cli.helpers import called
from tests.interfaces.conftest import HERE

METHODS = ("discs", "cones", "surface", "doubtful", "fittest", "drift")
DRAWN = ("discs", "fittest", "drift")
FLAGS = {
    "discs": "--max-num-iterations 250 --learning-rate 0.05",
    "cones": "--max-num-iterations 150 --num-rays-per-batch 256",
    "surface": "--max-num-iterations 150 --samples-per-batch 4096 --grid-resolution 16 --num-steps 64",
    "doubtful": "--max-num-iterations 150 --samples-per-batch 4096 --grid-resolution 16 --num-steps 64",
    "fittest": "--max-num-iterations 150 --start random --num-gaussians 1000 --steps-per-move 10",
    "drift": "--max-num-iterations 150 --start random --num-gaussians 1000 --steps-per-move 10",
}
SMALL = {
    "discs": {},
    "cones": {"num_samples": 16},
    "surface": {"samples_per_batch": 2**12, "grid_resolution": 16, "num_steps": 64},
    "doubtful": {"samples_per_batch": 2**12, "grid_resolution": 16, "num_steps": 64, "num_levels": 4},
    "fittest": {"start": "random", "num_gaussians": 600, "start_gaussians": 400, "steps_per_move": 10},
    "drift": {"start": "random", "num_gaussians": 600, "start_gaussians": 400, "steps_per_move": 10},
}
SCENE = "procedural --size 24 --num-train 8"


@pytest.mark.parametrize("name", METHODS)
def test_each_is_at_most_80_lines(name: str) -> None:
    assert len((HERE / "methods" / f"{name}.py").read_text().splitlines()) <= 80


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Trains a method by the command, once; returns the run's folder."""
    output = tmp_path_factory.mktemp("out")

    @functools.cache
    def train(name: str) -> Path:
        done = called(
            "ns-train", name, *FLAGS[name].split(), "--vis", "none", "--output-dir", output,
            "--timestamp", "t", "--experiment-name", "e", *SCENE.split(),
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        return output / "e" / name / "t"

    return train


@pytest.mark.medium
@pytest.mark.parametrize("name", METHODS)
def test_each_is_trained_evaluated_and_rendered_by_the_commands(
    name: str, trained: Callable[[str], Path], tmp_path: Path
) -> None:
    folder = trained(name)
    results = json.loads((folder / "eval.json").read_text())["results"]
    assert results["psnr"] > {"discs": 13}.get(name, 14), results
    assert called("ns-eval", folder, "--output-path", tmp_path / "again.json").returncode == 0
    again = json.loads((tmp_path / "again.json").read_text())["results"]["psnr"]
    assert again == pytest.approx(results["psnr"], abs=1e-4)
    orbit = tmp_path / "orbit.gif"
    flags = ["--output-path", orbit, "--num-frames", "3", "--downscale-factor", "2"]
    assert called("ns-render", "orbit", "--load-config", folder / "config.yml", *flags).returncode == 0
    assert imageio.imread(orbit).shape[0] == 3


@pytest.mark.medium
@pytest.mark.parametrize("name", METHODS)
def test_each_keeps_what_every_method_must(name: str) -> None:
    """The checks suit its kind: checks of rays are left out if none is cast."""
    method = load_method(name)
    findings = check_method(method, name, dataclasses.replace(method.config, **SMALL[name]))
    failed = [finding.line() for finding in findings if not finding.ok]
    assert failed == []
    assert ("chunks" in {finding.check for finding in findings}) == (name not in DRAWN)


@pytest.mark.medium
def test_an_output_of_ones_own_is_shown_wherever_pictures_are(trained: Callable[[str], Path], tmp_path: Path) -> None:
    """It is in the files of an evaluation, in a video beside the colours, in the viewer's list, and in Python."""
    folder = trained("doubtful")
    (shown, *_) = sorted((folder / "pictures").glob("*_uncertainty.png"))
    assert np.ptp(imageio.imread(shown)) > 50  # it differs between matter and nothing
    flags = ["--num-frames", "2", "--rendered-output-names", "rgb", "uncertainty", str(folder)]
    done = called("ns-render", "orbit", *flags, "--output-path", tmp_path / "orbit.gif")
    assert done.returncode == 0, done.stderr
    assert "uncertainty: " in done.stderr
    assert imageio.imread(tmp_path / "orbit.gif").shape[1:3] == (24, 48)
    run = nerfloom.load(folder)
    picture = run.render(run.views("test")[0])
    assert [output.name for output in picture.outputs] == ["uncertainty"]
    assert float(picture.of("uncertainty").min()) >= 0.1
    assert nerfloom.image(picture, "uncertainty").size == (24, 24)
    assert called("ns-render", "orbit", folder, "--rendered-output-names", "doubt").returncode == 1
