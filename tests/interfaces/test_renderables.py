"""Something to look at that learns nothing is evaluated, rendered and viewed by the functions that the commands use."""

import dataclasses
import json
import time
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
import torch

import nerfloom
from nerfloom import View
from nerfloom.cli.render import main as render
from nerfloom.data.pixels.batch import composite
from nerfloom.training import load as loading
from nerfloom.viewer.browser import Browser
from nerfloom.viewer.render_queue import RenderQueue
from nerfloom.viewer.request import Pose, Request
from tests.interfaces.conftest import HERE
from tests.interfaces.renderables.beside import Beside
from tests.training.helpers import tiny_trainer


def trained(method: str, data: Path, folder: Path, steps: int) -> Path:
    """The folder of a short run."""
    tiny_trainer(method, data, folder, max_num_iterations=steps).train()
    return folder


@pytest.fixture(scope="module")
def runs(shared_tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> list[nerfloom.Loaded]:
    """A run that has learnt the ball, and one of another method that has hardly begun."""
    folder = tmp_path_factory.mktemp("runs")
    one = trained("instant-ngp", shared_tiny, folder / "one", 100)
    return [nerfloom.load(path) for path in (one, trained("vanilla-nerf", shared_tiny, folder / "other", 2))]


@pytest.fixture
def both(runs: list[nerfloom.Loaded]) -> nerfloom.Loaded:
    return dataclasses.replace(runs[0], model=Beside(runs[0].model, runs[1].model))


def test_it_is_at_most_80_lines() -> None:
    assert len((HERE / "renderables" / "beside.py").read_text().splitlines()) <= 80


@pytest.mark.medium
def test_two_runs_side_by_side_are_evaluated(both: nerfloom.Loaded, runs: list[nerfloom.Loaded]) -> None:
    """The error of an image is its halves' error, and its PSNR follows from the error."""
    data, squares = both.dataset("test"), []
    for index in range(len(data)):
        target = composite(data.image(index).float() / 255, both.model.background)
        halves = []
        for run, half in zip(runs, (slice(0, 10), slice(10, 20)), strict=True):
            rgb = run.render(data.view(index)).rgb.clamp(0, 1)
            halves.append((rgb - target)[:, half].double().square().mean())
        squares.append(torch.stack(halves).mean())
    expected = float((-10 * torch.stack(squares).log10()).mean())
    assert both.evaluate("test")["psnr"] == pytest.approx(expected, abs=1e-4)
    assert runs[1].evaluate("test")["psnr"] < expected < runs[0].evaluate("test")["psnr"]


@pytest.mark.medium
def test_it_is_rendered_by_the_command(
    both: nerfloom.Loaded, runs: list[nerfloom.Loaded], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each half of each frame equals its run's."""

    def frames(loaded: nerfloom.Loaded, name: str) -> np.ndarray:
        monkeypatch.setattr(loading, "load", lambda *_, **__: loaded)
        words = (
            "orbit",
            loaded.origin,
            "--num-frames",
            2,
            "--rendered-output-names",
            "rgb",
            "depth",
            "--depth-format",
            "npy",
        )
        monkeypatch.setattr("sys.argv", ["ns-render", *map(str, words), "--output-path", str(tmp_path / name)])
        render()
        assert np.load(tmp_path / name / "depth" / "00001.npy").shape == (20, 20)
        return np.stack([imageio.imread(tmp_path / name / f"{index:05d}.png") for index in range(2)])

    shown, left, right = (
        frames(loaded, name) for loaded, name in zip((both, *runs), ("both", "one", "other"), strict=True)
    )
    np.testing.assert_array_equal(shown[:, :, :10], left[:, :, :10])
    np.testing.assert_array_equal(shown[:, :, 10:], right[:, :, 10:])
    assert np.abs(left.astype(float) - right).mean() > 5
    assert json.loads((tmp_path / "both" / "render.json").read_text())["method"] == "instant-ngp"


@pytest.mark.medium
def test_it_is_viewed(both: nerfloom.Loaded) -> None:
    """The finished picture of a browser is the one that is rendered."""
    pictures, queue = list[np.ndarray](), RenderQueue(both)
    pose = Pose((1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 4.0), 0.7)
    request = Request(pose, 40, 30)
    queue.add(1, Browser(lambda image, quality: pictures.append(image)))
    queue.ask(1, lambda _: request)
    while queue.draw_next() is not None or queue._browsers[1].pieces:
        time.sleep(0.02)
    view = View(request.camera(), rays_per_pixel=both.model.rays_per_pixel)  # of both halves
    expected = both.render(view).rgb.clamp(0, 1)
    np.testing.assert_allclose(pictures[-1] / 255, expected.numpy(), atol=0.01)
