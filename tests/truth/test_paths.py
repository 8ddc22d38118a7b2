"""ns-render: cameras, times and sizes of the rendered pictures, and the duration of each."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from nerfloom import Picture, RayModel, View
from nerfloom.training.trained import load_trained
from tests.cli.helpers import TINY_NGP
from tests.conftest import EditJson
from tests.truth.test_run import command

FRAMES = 5


@pytest.fixture
def rendered(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """The request of each picture; each picture has another grey."""
    asked: list[dict[str, Any]] = []

    def render_view(model: Any, view: View, background: Tensor) -> Picture:
        grey = torch.full((view.height, view.width, 3), 0.1 * (len(asked) % FRAMES))
        camera = view.camera
        asked.append({"pose": camera.camera_to_worlds[0], "fx": float(camera.fx[0]), "time": view.time})
        return Picture(grey, *[torch.ones(view.height, view.width)] * 3)

    monkeypatch.setattr(RayModel, "render_view", render_view)
    return asked


def trained(data: Path, output: Path, method: str = "instant-ngp", *flags: object) -> Path:
    """The config of a run of one step."""
    words = ("--data", data, "--output-dir", output, "--timestamp", "t", "--max-eval-images", 0)
    command("ns-train", method, *words, "--max-num-iterations", 1, *flags)
    return output / data.name / method / "t" / "config.yml"


def test_pictures_have_the_size_that_was_learnt_from_reduced_as_asked_and_the_speed(
    tiny: Path, tmp_path: Path, rendered: list[dict[str, Any]]
) -> None:
    config = trained(tiny, tmp_path, "instant-ngp", *TINY_NGP, "--downscale-factor", 2)
    for factor in (1, 5):
        file = tmp_path / f"{factor}.gif"
        command(
            "ns-render", "orbit", "--load-config", config, "--output-path", file, "--num-frames", FRAMES,
            "--downscale-factor", factor, "--fps", 4,
        )  # fmt: skip
        with Image.open(file) as picture:
            assert picture.size == (10 // factor, 10 // factor)
            assert picture.info["duration"] == 250
    # Around the middle of the box, as high and far as the cameras, looking at it.
    cameras = load_trained(config).run.parser.parse(tiny, "train").cameras.camera_to_worlds[:, :, 3].numpy()
    for index, asked in enumerate(rendered[:FRAMES]):
        position, ahead = asked["pose"][:, 3].numpy(), -asked["pose"][:, 2].numpy()
        angle = 2 * np.pi * index / FRAMES
        radius = np.linalg.norm(cameras[:, :2], axis=-1).mean()
        expected = [radius * np.cos(angle), radius * np.sin(angle), cameras[:, 2].mean()]
        np.testing.assert_allclose(position, expected, atol=1e-4)
        np.testing.assert_allclose(ahead, -position / np.linalg.norm(position), atol=1e-5)
        assert asked["pose"][2, 1] > 0
        assert asked["time"] is None


@pytest.mark.medium
def test_time_runs_from_0_to_1_past_one_camera(
    tiny: Path, edit_json: EditJson, tmp_path: Path, rendered: list[dict[str, Any]]
) -> None:
    edit_json(lambda c: [frame.update(time=i / 9) for i, frame in enumerate(c["frames"])])
    small = ("--base-resolution", 4, "--num-scales", 1, "--time-resolution", 3, "--grid-resolution", 8, "--vis", "none")
    config = trained(tiny, tmp_path, "kplanes", *small)
    given = ("--load-config", config, "--num-frames", FRAMES)
    one = ("--split", "train", "--camera-index", 3)
    command("ns-render", "time", *given, *one, "--output-path", tmp_path / "time.png")
    command("ns-render", "orbit", *given, "--output-path", tmp_path / "orbit.gif", "--time", 0.25)
    command("ns-render", "interpolate", *given, "--output-path", tmp_path / "walk.gif")
    cameras = load_trained(config).run.parser.parse(tiny, "train").cameras.camera_to_worlds
    times = [asked["time"] for asked in rendered]
    assert times[:FRAMES] == pytest.approx([0, 0.25, 0.5, 0.75, 1])
    assert all(torch.equal(asked["pose"], cameras[3]) for asked in rendered[:FRAMES])
    assert times[FRAMES : 2 * FRAMES] == [0.25] * FRAMES
    assert times[2 * FRAMES :] == pytest.approx([0, 0.25, 0.5, 0.75, 1])
