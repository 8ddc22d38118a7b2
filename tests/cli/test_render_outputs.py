"""ns-render: its files against a ball at a known distance from every camera, and resumed renders."""

import errno
import json
import math
import os
import subprocess
import time
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from torch import Tensor

from nerfloom import Picture, RayModel, View
from nerfloom.cameras.camera_path import CameraPath, write_camera_path
from nerfloom.cli import render as render_command
from nerfloom.evaluation import frames
from nerfloom.training.trained import load_trained
from tests.cli.helpers import called, command, train
from tests.conftest import EditJson, Refused
from tests.dataparsers.captures import CX, CY, FX, FY, HEIGHT, POINTS, WIDTH, poses, to_scene, write_capture
from tests.training.helpers import tiny_trainer

CENTER, RADIUS = POINTS.mean(0), 0.4
"""Centre and radius of the ball, in the frame and the units of the input."""
FEW = ("--max-num-iterations", 1, "--max-eval-images", 0)


@pytest.fixture(scope="module")
def capture_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run of one step on a capture, which is turned, moved and scaled."""
    folder = tmp_path_factory.mktemp("capture")
    return train(write_capture(folder / "capture"), folder / "out", *FEW)


@pytest.fixture(scope="module")
def ball_run(shared_tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run of one step on the tiny data set."""
    return train(shared_tiny, tmp_path_factory.mktemp("out"), *FEW)


def distances(origins: np.ndarray, directions: np.ndarray, center: np.ndarray, radius: float) -> np.ndarray:
    """Distances of a ball along rays; NaN where they miss it."""
    away = origins - center
    half = (away * directions).sum(-1)
    with np.errstate(invalid="ignore"):
        return -half - np.sqrt(half**2 - (away**2).sum(-1) + radius**2)


@pytest.fixture
def shows_a_ball(monkeypatch: pytest.MonkeyPatch, capture_run: Path) -> float:
    """Every model shows the ball, of the grey 0.25, in its scene's units; returns the scene's units per unit."""
    parsed = load_trained(capture_run).run.parse("train")
    center, scale = to_scene(parsed, CENTER[None])[0].numpy(), parsed.scale
    assert scale < 0.5

    def render_view(model: Any, view: View, background: Tensor) -> Picture:
        rays = view.camera.pixel_rays(view.pixels().flatten(), 0.0, 1.0)
        found = distances(
            *(part.double().cpu().numpy() for part in (rays.origins, rays.directions)), center, RADIUS * scale
        )
        depth = torch.from_numpy(found).float().view(view.height, view.width)
        hit = ~depth.isnan()
        depth = torch.where(hit, depth, 1000.0)
        rgb = torch.where(hit[..., None], torch.tensor(0.25), background)
        return Picture(rgb, depth, 2 * depth, hit.float())

    monkeypatch.setattr(RayModel, "render_view", render_view)
    return scale


def expected_distances(pose: np.ndarray) -> np.ndarray:
    """Distances of the ball in a photograph, from the cameras of the input alone."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    local = np.stack([(columns - CX) / FX, -(rows - CY) / FY, -np.ones_like(rows)], axis=-1)
    directions = local @ pose[:3, :3].T
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    return np.nan_to_num(distances(pose[:3, 3], directions, CENTER, RADIUS))


@pytest.mark.parametrize("kind", ["png16", "npy"])
def test_depth_is_in_units_of_the_input(kind: str, capture_run: Path, shows_a_ball: float, tmp_path: Path) -> None:
    words = ("--rendered-output-names", "depth", "rgb", "--depth-format", kind, "--split", "train")
    done = called("ns-render", "dataset", capture_run, "--output-path", tmp_path / "r", *words)
    assert done.returncode == 0, done.stderr
    folder = tmp_path / "r" / "train"
    meaning = json.loads((folder / "depth" / "depth.json").read_text())
    files = sorted(file for file in (folder / "depth").iterdir() if file.stem != "depth")
    assert [file.stem for file in files] == [f"{index:03d}" for index in (1, 2, 3, 4, 5, 6, 7)]
    for file in files:
        found = meaning["unit"] * (iio.imread(file) if kind == "png16" else np.load(file)).astype(np.float64)
        expected = expected_distances(poses()[int(file.stem)])
        seen = (expected > 0) & (found > 0)
        assert seen.sum() > 50
        assert ((expected > 0) != (found > 0)).sum() <= 2  # float32 at the very edge
        assert np.abs(found - expected)[seen].max() < 2e-4 + (meaning["unit"] / 2 if kind == "png16" else 0)
    assert len(list((folder / "rgb").iterdir())) == 7
    assert not (tmp_path / "r" / "train.frames").exists()


@pytest.mark.medium
def test_colours_of_depth_have_one_range_for_the_whole_video(
    capture_run: Path, shows_a_ball: float, tmp_path: Path
) -> None:
    pytest.importorskip("imageio_ffmpeg")
    words = (
        "--rendered-output-names",
        "rgb",
        "depth",
        "accumulation",
        "--num-frames",
        4,
        "--fps",
        8,
        "--loop",
        "False",
    )
    done = called("ns-render", "interpolate", capture_run, "--output-path", tmp_path / "a.mp4", *words)
    assert done.returncode == 0, done.stderr
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("depth: ")]
    near, far = (float(word) for word in line.split() if word[0].isdigit())
    every = np.concatenate([expected[expected > 0] for expected in map(expected_distances, poses())])
    assert near == pytest.approx(every.min(), abs=0.15)
    assert far == pytest.approx(every.max(), abs=0.15)
    video = iio.imread(tmp_path / "a.mp4", plugin="FFMPEG")
    assert video.shape == (4, HEIGHT, 3 * WIDTH, 3)
    assert iio.immeta(tmp_path / "a.mp4", plugin="FFMPEG")["fps"] == 8
    rgb, depth, opacity = np.split(video.astype(float), 3, axis=2)
    inside = opacity[..., 0] > 200
    assert rgb[inside].mean() == pytest.approx(64, abs=6)
    assert depth[~inside & (opacity[..., 0] < 50)].mean() > 235  # fades to white
    assert depth[inside].std(axis=0).max() > 15
    given = called(
        "ns-render", "interpolate", capture_run, "--output-path", tmp_path / "b.gif", *words,
        "--depth-near-plane", 1, "--depth-far-plane", 9,
    )  # fmt: skip
    assert "depth: 1 (dark) to 9 (light), in units of the input" in given.stderr


def test_an_orbit_goes_where_a_capture_was_taken_from(
    capture_run: Path, ball_run: Path, shows_a_ball: float, tmp_path: Path
) -> None:
    """The cameras stand on 3.8 radians of a circle, but for the held-out ends of it."""
    words = ("--num-frames", 4, "--output-path", tmp_path / "frames")
    done = called("ns-render", "orbit", capture_run, *words)
    assert done.returncode == 0, done.stderr
    (around,) = (int(line.split()[3]) for line in done.stderr.splitlines() if "the path swings to and fro" in line)
    assert around == pytest.approx(math.degrees(3.8) * 6 / 8, abs=2)  # the first and the last of nine are held out
    frames = [iio.imread(tmp_path / "frames" / f"{index:05d}.png") for index in range(4)]
    assert np.array_equal(frames[0], frames[2])  # the middle, both ways
    for run, flags in ((capture_run, ("--full-circle", "True")), (ball_run, ())):
        assert "swings" not in called("ns-render", "orbit", run, *words, *flags).stderr


def test_outputs_apart_and_in_folders(capture_run: Path, shows_a_ball: float, tmp_path: Path) -> None:
    words = ("--num-frames", 2, "--rendered-output-names", "rgb", "accumulation")
    for output in ("a.gif", "apart", "beside"):
        apart = ("--apart", "True") if output != "beside" else ("--image-format", "jpeg")
        done = called("ns-render", "spiral", *words, capture_run, "--output-path", tmp_path / output, *apart)
        assert done.returncode == 0, done.stderr
    found = {file.relative_to(tmp_path).as_posix() for file in tmp_path.rglob("*") if file.is_file()}
    assert found == {
        "a-rgb.gif", "a-accumulation.gif",
        "apart/rgb/00000.png", "apart/rgb/00001.png", "apart/accumulation/00000.png", "apart/accumulation/00001.png",
        "apart/render.json", "beside/00000.jpg", "beside/00001.jpg", "beside/render.json",
    }  # fmt: skip
    assert iio.imread(tmp_path / "beside" / "00000.jpg").shape == (HEIGHT, 2 * WIDTH, 3)
    again = called("ns-render", "spiral", *words, capture_run, "--output-path", tmp_path / "beside")
    assert again.returncode == 1
    assert "(render.json differs)" in again.stderr


@pytest.mark.medium
def test_the_true_image_and_the_error(ball_run: Path, shared_tiny: Path, tmp_path: Path) -> None:
    words = ("--rendered-output-names", "rgb", "gt-rgb", "error")
    for factor in (1, 2):
        output = tmp_path / f"r{factor}"
        done = called("ns-render", "dataset", ball_run, "--output-path", output, *words, "--downscale-factor", factor)
        assert done.returncode == 0, done.stderr
        for index in range(3):
            rgb, truth, error = (iio.imread(output / "test" / name / f"r_{index}.png") for name in words[1:])
            rgba = iio.imread(shared_tiny / "test" / f"r_{index}.png").astype(float)
            over_white = rgba[..., :3] * rgba[..., 3:] / 255 + 255 - rgba[..., 3:]
            size = 20 // factor
            expected = over_white.reshape(size, factor, size, factor, 3).mean((1, 3))
            assert np.abs(truth - expected).max() < (1 if factor == 1 else 2)
            off = np.abs(rgb.astype(float) - truth).mean(-1) / 255 / 0.25
            assert np.abs(error[..., 0] / 255 - np.clip(3 * off, 0, 1)).max() < 0.04


@pytest.mark.medium
@pytest.mark.parametrize("outputs", [("rgb", "depth"), ("rgb",)])
def test_a_killed_render_goes_on_to_the_same_file(
    outputs: tuple[str, ...], ball_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Colours of depths are those of all frames; a video of colours alone is encoded meanwhile."""
    ending = ".mp4" if find_spec("imageio_ffmpeg") else ".gif"
    words = ("orbit", ball_run, "--num-frames", 6, "--rendered-output-names", *outputs)
    whole, parts = tmp_path / f"whole{ending}", tmp_path / f"parts{ending}"
    assert called("ns-render", *words, "--output-path", whole).returncode == 0
    rendered: list[int] = []
    render_view, stop = RayModel.render_view, 4

    def counted(model: Any, view: View, background: Tensor) -> Picture:
        rendered.append(1)
        if len(rendered) == stop:
            raise KeyboardInterrupt
        return render_view(model, view, background)

    monkeypatch.setattr(RayModel, "render_view", counted)
    stopped = called("ns-render", *words, "--output-path", parts)
    assert stopped.returncode == 130
    assert "3 of 6 frames are in" in stopped.stderr
    assert not parts.exists()
    # Another command does not take them, and does not remove them.
    other = called("ns-render", *words, "--output-path", parts, "--downscale-factor", 2)
    assert "has frames of another render" in other.stderr
    assert len(rendered) == 4 + 6
    other_bytes = parts.read_bytes()
    stop = -1
    done = called("ns-render", *words, "--output-path", parts)
    assert "3 of 6 frames already exist" in done.stderr
    assert len(rendered) == 4 + 6 + 3
    assert parts.read_bytes() == whole.read_bytes() != other_bytes
    assert sorted(file.name for file in tmp_path.iterdir()) == sorted([whole.name, parts.name])


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="SIGKILL")
def test_a_process_that_is_killed_loses_no_frame(ball_run: Path, tmp_path: Path) -> None:
    words = ("orbit", ball_run, "--num-frames", 60)
    whole, parts = tmp_path / "whole.gif", tmp_path / "parts.gif"
    assert called("ns-render", *words, "--output-path", whole).returncode == 0
    with subprocess.Popen([command("ns-render"), *map(str, words), "--output-path", str(parts)]) as process:
        while process.poll() is None and len(list(tmp_path.glob("parts.gif.frames/*/*.npz"))) < 3:
            time.sleep(0.005)
        process.kill()
    assert not parts.exists()
    done = called("ns-render", *words, "--output-path", parts)
    assert "of 60 frames already exist" in done.stderr
    assert parts.read_bytes() == whole.read_bytes()
    assert sorted(file.name for file in tmp_path.iterdir()) == ["parts.gif", "whole.gif"]


def test_a_full_disk_is_a_line_and_keeps_the_frames(
    ball_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: Refused
) -> None:
    write, written = frames.write_atomically, []

    def full(path: Path, content: Any, flush: bool) -> None:
        written.append(path)
        if len(written) > 3:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        write(path, content, flush)

    monkeypatch.setattr(frames, "write_atomically", full)
    said = refused(render_command.main, "orbit", ball_run, "--output-path", tmp_path / "a.gif", "--num-frames", 4)
    assert said.endswith("000002.npz: No space left on device; free some space, and repeat the command")
    assert len(list((tmp_path / "a.gif.frames").glob("*/*.npz"))) == 2


def test_a_camera_path_is_rendered_at_its_times_and_speed(
    tiny: Path, edit_json: EditJson, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    edit_json(lambda c: [frame.update(time=i / 9) for i, frame in enumerate(c["frames"])])
    trainer = tiny_trainer("kplanes", tiny, tmp_path / "run", max_num_iterations=1)
    trainer.train()
    asked: list[View] = []

    def render_view(model: Any, view: View, background: Tensor) -> Picture:
        asked.append(view)
        return Picture(torch.full((view.height, view.width, 3), 0.1 * len(asked)), *[torch.ones(view.height, 1)] * 3)

    monkeypatch.setattr(RayModel, "render_view", render_view)
    cameras = torch.eye(4, dtype=torch.float64)[:3].repeat(3, 1, 1)
    cameras[:, 0, 3] = torch.tensor([1.0, 2, 3])
    path = CameraPath(
        "perspective", 48, 32, cameras, torch.full((3,), 53.13010235), 0.75, times=torch.tensor([0.5, 0.25, 1.0])
    )  # fmt: skip
    write_camera_path(tmp_path / "camera_path.json", path)
    words = ("camera-path", trainer.folder, "--camera-path-filename", tmp_path / "camera_path.json")
    done = called("ns-render", *words, "--output-path", tmp_path / "a.gif", "--downscale-factor", 2)
    assert done.returncode == 0, done.stderr
    assert [view.time for view in asked] == [0.5, 0.25, 1.0]
    assert [float(view.camera.camera_to_worlds[0, 0, 3]) for view in asked] == [1, 2, 3]
    assert [(view.width, view.height) for view in asked] == [(24, 16)] * 3
    assert float(asked[0].camera.fx[0]) == pytest.approx(16 / 2 / math.tan(math.radians(53.13010235) / 2))
    assert iio.immeta(tmp_path / "a.gif")["duration"] == 250


def test_pictures_of_another_camera_path_are_left_alone(ball_run: Path, tmp_path: Path) -> None:
    """A path of as many frames, of the same size, under the same name."""
    file, output = tmp_path / "path.json", tmp_path / "pictures"
    words = ("camera-path", ball_run, "--camera-path-filename", file, "--output-path", output)

    def done(away: float) -> int:
        cameras = torch.eye(4, dtype=torch.float64)[:3].repeat(2, 1, 1)
        cameras[:, 2, 3] = away
        write_camera_path(file, CameraPath("perspective", 12, 8, cameras, torch.full((2,), 50.0), 0.5))
        return called("ns-render", *words).returncode

    assert done(4.0) == 0
    before = {path.name: path.read_bytes() for path in output.iterdir() if path.is_file()}
    assert len([name for name in before if name.endswith(".png")]) == 2
    assert done(4.0) == 0
    assert done(3.0) == 1
    assert {path.name: path.read_bytes() for path in output.iterdir() if path.is_file()} == before


def test_what_cannot_be_rendered_is_refused_at_once(ball_run: Path, tmp_path: Path, refused: Refused) -> None:
    def said(*words: object, status: int = 2) -> str:
        return refused(render_command.main, *words, "--output-path", tmp_path / "a.gif", status=status)

    nowhere = tmp_path / "none"
    names = "--rendered-output-names"
    assert "'ns-render dataset'" in said("orbit", nowhere, names, "rgb", "error")
    assert "name at least one output, and each once" in said("orbit", nowhere, names, "rgb", "rgb")
    assert "add depth to --rendered-output-names" in said("orbit", nowhere, "--depth-format", "npy")
    assert "needs a folder" in said("orbit", nowhere, names, "depth", "--depth-format", "npy")
    assert "near must be from 0 to far" in said("orbit", nowhere, "--depth-near-plane", 3, "--depth-far-plane", 2)
    assert "--fps more than 0" in said("orbit", nowhere, "--fps", 0)
    assert "--radius is -1; it must be above zero" in said("spiral", nowhere, "--radius", -1)
    assert "--seconds is 0; it must be above zero" in said("interpolate", nowhere, "--seconds", 0)
    assert "--width is 0" in said("time", nowhere, "--width", 0)
    assert "--fov is 180" in said("camera-path", nowhere, "--fov", 180)
    assert "'pink' is not a colour" in said("orbit", nowhere, "--background", "pink")
    words = ("--frame", "exports", "--dataparser-transforms", nowhere)
    assert "--frame exports has none" in said("camera-path", nowhere, *words)
    avi = refused(render_command.main, "orbit", nowhere, "--output-path", tmp_path / "a.avi", status=2)
    assert avi.endswith("the extension must be .mp4, .gif, .webp, .png, or none for a folder of images")
    assert "no such output" in said("orbit", ball_run, names, "normals", "--num-frames", 1, status=1)
    assert "at most 50 frames per second" in said("orbit", ball_run, "--fps", 60, "--num-frames", 1, status=1)
    assert not list(tmp_path.iterdir())
    path = ("camera-path", ball_run, "--camera-path-filename", nowhere)
    assert said(*path, status=1).endswith("none: No such file or directory")
    assert "the run knows its data format; leave it out" in said("orbit", ball_run, "blender", status=1)
    assert "is of nerfstudio's ns-render; here it is --fps" in said("interpolate", nowhere, "--frame_rate=24")
    assert "the extension of --output-path sets the format" in said("spiral", nowhere, "--output-format", "images")


def test_the_bound_of_the_error_is_said(ball_run: Path, tmp_path: Path) -> None:
    done = called(
        "ns-render", "orbit", ball_run, "--output-path", tmp_path / "a.gif", "--num-frames", 1, "--max-error", "1/255"
    )
    assert done.returncode == 0, done.stderr
    assert "at most 0.0039" in done.stderr


def test_a_video_has_the_size_the_opening_and_the_length_that_are_asked_for(
    ball_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[View] = []

    def render_view(model: Any, view: View, background: Tensor) -> Picture:
        asked.append(view)
        grey = background.expand(view.height, view.width, 3)
        return Picture(grey, *[torch.ones(view.height, view.width)] * 3)

    monkeypatch.setattr(RayModel, "render_view", render_view)
    size = ("--seconds", 0.2, "--fps", 20, "--width", 32, "--height", 18, "--fov", 60, "--background", "#ff8000")
    done = called("ns-render", "orbit", ball_run, *size, "--output-path", tmp_path / "frames")
    assert done.returncode == 0, done.stderr
    assert [(view.width, view.height) for view in asked] == [(32, 18)] * 4
    for view in asked:
        # Half of 60 degrees of the height; by the aspect ratio, the width shows 2 atan(32 / 18 tan 30 deg).
        assert float(view.camera.fy[0]) == pytest.approx(9 / math.tan(math.radians(30)))
        opening = 2 * math.atan(32 / 2 / float(view.camera.fx[0]))
        assert opening == pytest.approx(2 * math.atan(32 / 18 * math.tan(math.radians(30))))
    assert iio.imread(tmp_path / "frames" / "00003.png")[9, 16].tolist() == [255, 128, 0]
    assert "the other 2 frames take about" in done.stderr


def test_a_path_around_exports_is_in_their_frame(
    capture_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A camera at a photograph's pose in the frame of the input sees the photograph's part of the scene."""
    asked: list[View] = []

    def render_view(model: Any, view: View, background: Tensor) -> Picture:
        asked.append(view)
        return Picture(torch.zeros(view.height, view.width, 3), *[torch.ones(view.height, view.width)] * 3)

    monkeypatch.setattr(RayModel, "render_view", render_view)
    loaded = load_trained(capture_run)
    camera = loaded.run.parse("train").cameras.camera_to_worlds[2]
    pose = loaded.placement.original_poses(camera[None])[0]
    frame = {"camera_to_world": [*pose.flatten().tolist(), 0, 0, 0, 1], "fov": 50}
    path = {"render_height": 8, "render_width": 8, "fps": 4, "camera_path": [frame]}
    (tmp_path / "path.json").write_text(json.dumps(path))
    words = ("camera-path", capture_run, "--camera-path-filename", tmp_path / "path.json", "--frame", "exports")
    done = called("ns-render", *words, "--output-path", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    torch.testing.assert_close(asked[0].camera.camera_to_worlds[0], camera, atol=1e-5, rtol=1e-5)


def test_the_radius_of_an_orbit_is_in_the_unit_of_exports(
    capture_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    places: list[Tensor] = []

    def render_view(model: Any, view: View, background: Tensor) -> Picture:
        places.append(view.camera.camera_to_worlds[0, :, 3])
        return Picture(torch.zeros(view.height, view.width, 3), *[torch.ones(view.height, view.width)] * 3)

    monkeypatch.setattr(RayModel, "render_view", render_view)
    for name, radius in (("as they are", ()), ("near", ("--radius", 1.5))):
        done = called("ns-render", "orbit", capture_run, "--num-frames", 4, *radius, "--output-path", tmp_path / name)
        assert done.returncode == 0, done.stderr
    placement = load_trained(capture_run).placement
    offsets = placement.original_points(torch.stack(places)) - torch.from_numpy(CENTER)  # which the cameras look at
    cameras = torch.from_numpy(poses()[1:8, :3, 3] - CENTER)  # the first and the last are held out
    up = placement.original_directions(torch.tensor([[0.0, 0, 1]]))[0]
    horizontal = (cameras - (cameras @ up)[:, None] * up).norm(dim=-1).mean()
    torch.testing.assert_close(offsets[4:], offsets[:4] * (1.5 / horizontal), atol=1e-4, rtol=0)
