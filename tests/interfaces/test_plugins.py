"""A plugin brings a renderer, a sampler, a field or a data format alone; an existing method uses it by one line."""

import json
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
import torch

from nerfloom import Rays
from nerfloom.methods import instant_ngp
from nerfloom.registry import load_method
from nerfloom.stress.scenes import ball_dataset
from tests.cli.helpers import TINY_NGP, called
from tests.interfaces.conftest import HERE

SMALL = "--max-num-iterations 40 --vis none --num-steps 64 --grid-resolution 16"
# A sampler that does not adapt the number of rays to its samples takes --num-rays-per-batch of them.
TINY = [*TINY_NGP, "--max-num-iterations", "40", "--rays-per-pixel", "1", "--num-rays-per-batch", "256"]
SCENE = "procedural --size 24 --num-train 8"


@pytest.mark.parametrize("file", sorted((HERE / "plugins").glob("[a-z]*.py")), ids=lambda file: file.stem)
def test_each_is_under_60_lines(file: Path) -> None:
    assert len(file.read_text().splitlines()) < 60


@pytest.mark.parametrize("name", ["fog", "even", "vertices"])
def test_each_exchanges_one_part_by_one_line(name: str) -> None:
    method, original = load_method(name), instant_ngp.METHOD
    parts = ("field", "sampler", "renderer", "model", "decide", "config")
    changed = [part for part in parts if getattr(method, part) is not getattr(original, part)]
    assert changed == [{"fog": "renderer", "even": "sampler", "vertices": "field"}[name]]
    (line,) = [line for line in (HERE / "plugins" / f"{name}.py").read_text().splitlines() if "METHOD = " in line]
    assert line.startswith("METHOD = replace(instant_ngp.METHOD, ")


@pytest.mark.medium
@pytest.mark.parametrize("name", ["fog", "even", "vertices"])
def test_each_is_trained_and_evaluated_by_the_commands(name: str, tmp_path: Path) -> None:
    done = called(
        "ns-train", name, *TINY, "--output-dir", tmp_path, "--timestamp", "t", "--experiment-name", "e", *SCENE.split()
    )
    assert done.returncode == 0, done.stderr
    folder = tmp_path / "e" / name / "t"
    trained = json.loads((folder / "eval.json").read_text())["results"]["psnr"]
    assert called("ns-eval", folder, "--output-path", tmp_path / "again.json").returncode == 0
    assert json.loads((tmp_path / "again.json").read_text())["results"]["psnr"] == pytest.approx(trained, abs=1e-4)
    assert trained > 8  # a picture of the background alone has less than that


def test_fog_hides_by_distance() -> None:
    """Grey where a ray goes far, and the colour itself where it ends at once: by hand."""
    from benchmarks.closed_forms import scenes
    from nerfloom.samplers.uniform import UniformSampler
    from tests.interfaces.plugins.fog import DENSITY, GREY, FogRenderer

    field = scenes()["nested"]
    rays = Rays(torch.tensor([[0.0, 0, 4]]), torch.tensor([[0.0, 0, -1]]), torch.tensor([2.0]), torch.tensor([6.0]))
    samples = UniformSampler(256).sample(rays, field, False)
    clear = super(FogRenderer, FogRenderer()).render(rays, samples, field, torch.ones(3))
    foggy = FogRenderer().render(rays, samples, field, torch.ones(3))
    left = np.exp(-DENSITY * float(clear.depth))
    np.testing.assert_allclose(foggy.rgb, left * clear.rgb + (1 - left) * GREY, rtol=1e-6)


@pytest.mark.medium
def test_a_data_format_alone(tmp_path: Path) -> None:
    """Images of a ball from a circle, found by their names, teach instant-ngp the ball."""
    angles = torch.arange(0, 360, 30)
    around = torch.stack([torch.cos(angles.deg2rad()), torch.sin(angles.deg2rad()), 0 * angles], -1)
    dataset = ball_dataset(4 * around, 40.0)
    for index, angle in enumerate(angles.tolist()):
        imageio.imwrite(tmp_path / f"{angle:03d}.png", dataset.image(index).numpy())
    out = tmp_path / "out"
    done = called(
        "ns-train", "instant-ngp", "--data", tmp_path, *TINY, "--max-num-iterations", "150", "--output-dir", out,
        "--timestamp", "t", "--experiment-name", "e", "ring", "--distance", "4.0",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    results = json.loads((out / "e" / "instant-ngp" / "t" / "eval.json").read_text())["results"]
    assert results["psnr"] > 20
