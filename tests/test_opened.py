"""Python and the commands write the same bytes, and the namespace is the interface."""

import dataclasses
import json
import math
import types
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch

import nerfloom
from nerfloom.base.errors import CheckpointError, ConfigError
from nerfloom.cameras.scale import Scale
from nerfloom.cli.process_data import main as process_data
from nerfloom.kernels.splats.project import DC
from nerfloom.processing import kinds
from nerfloom.processing.settings import ImagesFlags, VideoFlags
from nerfloom.splats.files import read_gaussians, write_gaussians
from nerfloom.splats.gaussians import Gaussians
from tests.cli.helpers import called, train

COUNT = 1500
"""Number of Gaussians of the ball."""


@pytest.fixture(scope="module")
def run(shared_tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run of one step."""
    return train(shared_tiny, tmp_path_factory.mktemp("out"), "--max-num-iterations", 1, "--max-eval-images", 0)


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file of opaque Gaussians on the unit sphere, which the photographs of the tiny data set look at."""
    index = torch.arange(COUNT) + 0.5
    z, angle = 1 - 2 * index / COUNT, index * math.pi * (3 - math.sqrt(5))
    away = (1 - z.square()).sqrt()
    unit = torch.stack([away * angle.cos(), away * angle.sin(), z], -1)
    turn = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(COUNT, 1)
    scales, logits = torch.full((COUNT, 3), math.log(0.05)), torch.full((COUNT,), 4.0)
    file = tmp_path_factory.mktemp("ball") / "ball.ply"
    write_gaussians(file, Gaussians(unit, scales, turn, logits, 0.4 * unit / DC, torch.zeros(COUNT, 3, 0)))
    return file


def contents(folder: Path) -> dict[str, bytes]:
    """Content of the files of a folder, by name."""
    return {file.relative_to(folder).as_posix(): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def test_a_training_takes_settings_of_the_data_format(shared_tiny: Path, tmp_path: Path) -> None:
    tiny: dict[str, Any] = {"num_levels": 4, "max_resolution": 64, "log2_table_size": 12, "grid_resolution": 16}
    tiny |= {"num_steps": 64, "samples_per_batch": 4096, "vis": "none", "output_dir": tmp_path / "out"}
    tiny |= {"max_num_iterations": 1, "max_eval_images": 0}
    whole = iio.imread(shared_tiny / "test" / "r_0.png").shape[:2]
    view = nerfloom.train("instant-ngp", shared_tiny, downscale_factor=2, **tiny).views("test")[0]
    assert (view.height, view.width) == (whole[0] // 2, whole[1] // 2)
    with pytest.raises(ConfigError, match="unknown key 'downscale'"):
        nerfloom.train("instant-ngp", shared_tiny, downscale=2, **tiny)


def test_a_path_is_rendered_as_by_the_command(run: Path, tmp_path: Path) -> None:
    words = ("--num-frames", 2, "--width", 16, "--rendered-output-names", "rgb", "depth", "--depth-format", "npy")
    more = ("--rays-per-pixel", 9, "--output-path", tmp_path / "command")
    done = called("ns-render", "orbit", run, *words, *more)
    assert done.returncode == 0, done.stderr
    settings: dict[str, Any] = {"num_frames": 2, "width": 16, "rendered_output_names": ("rgb", "depth")}
    settings["rays_per_pixel"] = 9
    nerfloom.load(run).render_path("orbit", tmp_path / "python", depth_format="npy", **settings)
    found = contents(tmp_path / "python")
    assert found == contents(tmp_path / "command")
    depths = {"depth/00000.npy", "depth/00001.npy", "depth/depth.json"}
    assert {"00000.png", "00001.png", "render.json"} | depths == found.keys()
    assert iio.imread(tmp_path / "python" / "00000.png").shape == (16, 16, 3)


def test_depth_is_in_the_unit_of_a_scale_and_says_so(ball: Path, tmp_path: Path) -> None:
    opened: Any = nerfloom.load(ball)
    settings: dict[str, Any] = {"num_frames": 1, "width": 16, "rendered_output_names": ("depth",)}
    distances, said = [], []
    for name, run in (("input", opened), ("metres", opened.scaled(Scale(2.5, "m")))):
        run.render_path("orbit", tmp_path / name, depth_format="npy", **settings)
        distances.append(np.load(tmp_path / name / "depth" / "00000.npy"))
        said.append(json.loads((tmp_path / name / "depth" / "depth.json").read_text())["distance"])
    assert float(distances[0].max()) > 0
    np.testing.assert_allclose(distances[1], 2.5 * distances[0], rtol=1e-5)
    assert "in units of the input:" in said[0]
    assert "in m:" in said[1]


def test_files_are_exported_as_by_the_command(run: Path, ball: Path, tmp_path: Path) -> None:
    opened = nerfloom.load(ball)
    page = {"title": "A ball", "start_view": "view 3"}
    asked: list[tuple[str, str, tuple[object, ...], dict[str, Any]]] = [
        ("gaussian-splat", "splat.ply", (), {}),
        ("gaussian-splat", "splat.spz", ("--format", "spz", "--max-megabytes", 0.01), {"max_megabytes": 0.01}),
        ("web", "scene.html", ("--title", "A ball", "--start-view", "view 3"), page),
    ]
    for kind, name, words, settings in asked:
        done = called("ns-export", kind, ball, "--output-dir", tmp_path / "command", *words)
        assert done.returncode == 0, done.stderr
        (tmp_path / "python").mkdir(exist_ok=True)
        opened.export(kind, tmp_path / "python" / name, **settings)
    assert called("ns-export", "cameras", run, "--output-dir", tmp_path / "command").returncode == 0
    nerfloom.load(run).export("cameras", tmp_path / "python" / "transforms_train.json")
    found, expected = contents(tmp_path / "python"), contents(tmp_path / "command")
    assert found.keys() == expected.keys() >= {"splat.ply", "splat.spz", "scene.html", "scene.jpg"}
    assert {name for name in found if found[name] != expected[name]} == set()


def test_regions_crop_as_the_flags_do(ball: Path, tmp_path: Path) -> None:
    done = called("ns-export", "gaussian-splat", ball, "--output-dir", tmp_path, "--crop-box=-2,-2,0,2,2,2")
    assert done.returncode == 0, done.stderr
    upper = nerfloom.edit.Box((-2, -2, 0), (2, 2, 2))
    nerfloom.load(ball).export("gaussian-splat", tmp_path / "python.ply", regions=[upper])
    assert (tmp_path / "python.ply").read_bytes() == (tmp_path / "splat.ply").read_bytes()
    with pytest.raises(ConfigError, match="cameras takes no region"):
        nerfloom.load(ball).export("cameras", tmp_path / "cameras.json", regions=[upper])


def test_a_point_cloud_lies_on_the_ball(ball: Path, shared_tiny: Path, tmp_path: Path) -> None:
    few: dict[str, Any] = {"num_points": 3000, "remove_outliers": False, "estimate_normals": False}
    opened = nerfloom.load(ball, data=shared_tiny)
    found = opened.point_cloud(**few)
    assert 500 < len(found) <= 3000
    assert found.normals is not None  # Gaussians have their own
    distances = found.positions.norm(dim=-1)
    assert float((distances - 1).abs().median()) < 0.15
    words = ("--data", shared_tiny, "--num-points", 3000, "--remove-outliers", "False", "--estimate-normals", "False")
    done = called("ns-export", "pointcloud", ball, "--output-dir", tmp_path, *words)
    assert done.returncode == 0, done.stderr
    found.write(tmp_path / "python.ply")
    assert (tmp_path / "python.ply").read_bytes() == (tmp_path / "point_cloud.ply").read_bytes()
    near = opened.point_cloud(regions=[nerfloom.edit.Sphere((0, 0, 1), 0.5)], **few)
    assert 0 < len(near) < len(found)
    assert float((near.positions - torch.tensor([0, 0, 1.0])).norm(dim=-1).max()) <= 0.5
    axes = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
    view = nerfloom.edit.Polygon((0.0, 0.0, 9.0), axes, ((0, -1), (1, -1), (1, 1), (0, 1)), keep=False)  # all of x > 0
    left = opened.point_cloud(regions=[view], **few)
    assert 0 < len(left) < len(found)
    assert float(left.positions[:, 0].max()) <= 0


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda run, file: run.render_path("orbi", file), "unknown path 'orbi'. Did you mean 'orbit'"),
        (lambda run, file: run.render_path("orbit", file, frames=3), "unknown key 'frames'"),
        (lambda run, file: run.render_path("orbit", file, width="wide"), "'width' is 'wide'"),
        (lambda run, file: run.render_path("orbit", file, fov=0.0), "--fov is 0"),
        (lambda run, file: run.render_path("orbit", file, rays_per_pixel=4), "no effect with Gaussians"),
        (lambda run, file: run.export("mesh", file), "nothing is exported as 'mesh'"),
        (lambda run, file: run.export("web", file), "web is written to .html files"),
        (lambda run, file: run.export("web", file.with_suffix(".html"), url="cup"), "--url is 'cup'"),
        (lambda run, file: run.export("web", file.with_suffix(".html"), start_view="view 9"), "no training image"),
        (lambda run, file: run.point_cloud(points=3), "unknown key 'points'"),
    ],
)
def test_mistakes_are_answered_in_a_line(call: Any, message: str, ball: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=message.replace("'", ".").replace(".html", "[.]html")):
        call(nerfloom.load(ball), tmp_path / "file.gif")
    assert list(tmp_path.iterdir()) == []


def test_what_is_replaced_or_rescaled_keeps_its_methods(ball: Path, tmp_path: Path) -> None:
    opened = nerfloom.load(ball)
    assert isinstance(opened, nerfloom.Opened)
    assert isinstance(opened, nerfloom.Loaded)
    other = dataclasses.replace(opened, method="other")
    other.export("gaussian-splat", tmp_path / "a.ply")
    assert (other.method, (tmp_path / "a.ply").is_file()) == ("other", True)
    opened.scaled(Scale(2.0, "cm")).export("gaussian-splat", tmp_path / "b.ply")
    one, two = (read_gaussians(tmp_path / name).gaussians.means for name in ("a.ply", "b.ply"))
    torch.testing.assert_close(two, 2 * one)


def test_photographs_are_processed_as_by_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    for name, flags in (("images", ImagesFlags), ("video", VideoFlags)):
        monkeypatch.setitem(kinds.KINDS, name, kinds.Kind(flags, asked.append))
    photographs, output = tmp_path / "photographs", tmp_path / "out"
    photographs.mkdir()
    iio.imwrite(photographs / "a.png", torch.zeros(4, 4, 3, dtype=torch.uint8).numpy())
    assert nerfloom.process(photographs, output, matching_method="sequential", num_downscales=1) == output
    words = ["images", "--data", photographs, "--output-dir", output]
    words += ["--matching-method", "sequential", "--num-downscales", 1]
    monkeypatch.setattr("sys.argv", ["ns-process-data", *map(str, words)])
    process_data()
    assert asked[0] == asked[1]
    assert asked[0].matching_method == "sequential"
    (tmp_path / "walk.mp4").write_bytes(b"")
    nerfloom.process(tmp_path / "walk.mp4", output, num_frames_target=50)
    assert isinstance(asked[2], VideoFlags)
    assert (asked[2].num_frames_target, asked[2].data) == (50, tmp_path / "walk.mp4")
    with pytest.raises(ConfigError, match="unknown kind"):
        nerfloom.process(photographs, output, kind="photos")
    with pytest.raises(ConfigError, match="unknown key"):
        nerfloom.process(photographs, output, matching="sequential")
    with pytest.raises(ConfigError, match="--num-downscales is 9"):
        nerfloom.process(photographs, output, num_downscales=9)


def test_the_namespace_holds_the_interface_alone() -> None:
    assert {name for name in dir(nerfloom) if not name.startswith("_")} == {*nerfloom.__all__, "edit"}
    for name, value in vars(nerfloom).items():
        if not name.startswith("_") and name not in nerfloom.__all__:  # rooms of the package, once imported
            assert isinstance(value, types.ModuleType)
            assert value.__name__ == f"nerfloom.{name}"


def test_a_file_stands_as_it_is_told_and_a_run_is_of_the_chosen_checkpoint(ball: Path, run: Path) -> None:
    ends = nerfloom.load(ball, up="-y").placement.points(torch.tensor([[0.0, 0, 0], [0, -1, 0]]))
    up = ends[1] - ends[0]
    torch.testing.assert_close(up / up.norm(), torch.tensor([0.0, 0, 1], dtype=torch.float64))
    wrong: Any = "up"
    with pytest.raises(ConfigError, match="it must be one of x, y, z, -x, -y, -z"):
        nerfloom.load(ball, up=wrong)
    checkpoint = min((run / "nerfstudio_models").glob("*.ckpt"))
    assert nerfloom.load(run, checkpoint=checkpoint).checkpoint == checkpoint
    with pytest.raises(CheckpointError, match=r"none\.ckpt"):
        nerfloom.load(run, checkpoint=str(run / "none.ckpt"))


def test_a_camera_is_made_by_hand_and_rendered(ball: Path) -> None:
    """Seen from x = 4 of the input, the ball of radius 1 is in the middle, with the size given by its tangents."""
    opened = nerfloom.load(ball)
    middle = torch.zeros(3)
    pose = nerfloom.look_at(opened.placement.points(torch.tensor([[4.0, 0, 0]]))[0].float(), middle)
    focal, half, side = torch.tensor([100.0]), torch.tensor([50.0]), torch.tensor([100])
    picture = opened.render(nerfloom.Cameras(pose[None], focal, focal, half, half, side, side))
    assert float(picture.accumulation[50, 50]) > 0.9
    radius = 100 * math.tan(math.asin(1 / 4))
    shown = float((picture.accumulation > 0.5).float().sum() / math.pi) ** 0.5
    assert shown == pytest.approx(radius, rel=0.15)
