"""Files of Gaussians without photographs: every command that needs none opens them, in a frame of their own."""

import json
import math
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch

import nerfloom
from nerfloom.base.errors import ConfigError, DataError
from nerfloom.cli import evaluate as eval_command
from nerfloom.cli import export as export_command
from nerfloom.cli import render as render_command
from nerfloom.evaluation.paths import around
from nerfloom.export.web import gaussians_of
from nerfloom.kernels.splats.project import DC
from nerfloom.splats.files import read_gaussians, write_gaussians
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.placement import HALF_WITHIN, direction_of, placed_gaussians
from nerfloom.splats.transform import transformed
from nerfloom.viewer.browser import Browser
from nerfloom.viewer.render_queue import RenderQueue
from nerfloom.viewer.request import Pose, Request
from tests.cli.helpers import called
from tests.conftest import Refused

SMALL = ("--num-frames", 3, "--downscale-factor", 16)
MIDDLE = torch.tensor([3.0, -2.0, 5.0])


def ball(count: int = 400, radius: float = 4.0) -> Gaussians:
    """Opaque Gaussians on a sphere, red above its middle along z and blue below, in a Fibonacci lattice."""
    index = torch.arange(count) + 0.5
    z, angle = 1 - 2 * index / count, index * math.pi * (3 - math.sqrt(5))
    around_z = (1 - z.square()).sqrt()
    unit = torch.stack([around_z * angle.cos(), around_z * angle.sin(), z], -1)
    color = torch.where(z[:, None] > 0, torch.tensor([0.9, 0.1, 0.1]), torch.tensor([0.1, 0.1, 0.9]))
    turn = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1)
    scales = torch.full((count, 3), math.log(0.1 * radius))
    return Gaussians(
        MIDDLE + radius * unit, scales, turn, torch.full((count,), 4.0), (color - 0.5) / DC, torch.zeros(count, 3, 0)
    )


@pytest.fixture(params=["ply", "spz", "sog"])
def file(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    write_gaussians(tmp_path / f"x.{request.param}", ball())
    return tmp_path / f"x.{request.param}"


def orbit(file: Path, name: str, *flags: object) -> np.ndarray:
    """Frames (F, H, W, 3)."""
    folder = file.parent / name
    done = called("ns-render", "orbit", file, *SMALL, "--output-path", folder, *flags)
    assert done.returncode == 0, done.stderr
    return np.stack([iio.imread(path) for path in sorted(folder.glob("*.png"))]).astype(float)


def test_half_of_them_are_near_the_middle_and_the_rest_does_not_count() -> None:
    given = ball()
    placement, scene = placed_gaussians(given)
    placed = placement.points(given.means)
    assert float(placed.norm(dim=-1).median()) == pytest.approx(HALF_WITHIN, rel=1e-3)
    assert scene.has_alpha
    assert not scene.unbounded
    stray = given[torch.arange(300)].map(torch.clone)
    stray.means[:20] += 1e4
    stray.means[20] = math.nan
    placement, scene = placed_gaussians(stray)
    assert float(placement.points(stray.means[21:]).norm(dim=-1).median()) == pytest.approx(HALF_WITHIN, rel=0.1)
    assert scene.unbounded
    with pytest.raises(DataError, match="no Gaussian with finite numbers"):
        placed_gaussians(given.map(lambda values: torch.full_like(values, math.nan)))


@pytest.mark.parametrize(("up", "axis"), [("z", (0, 0, 1)), ("-y", (0, -1, 0)), ("x", (1, 0, 0)), ("-z", (0, 0, -1))])
def test_up_is_up(up: str, axis: tuple[float, float, float]) -> None:
    placement, _ = placed_gaussians(ball(), direction_of(up))  # type: ignore[arg-type]
    turned = placement.transform[:, :3] @ torch.tensor(axis, dtype=torch.float64)
    torch.testing.assert_close(turned, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    assert float(torch.linalg.det(placement.transform[:, :3])) == pytest.approx(1)


def test_cameras_go_around() -> None:
    _, scene = placed_gaussians(ball())
    cameras = around(scene, 6)
    assert len(cameras) == 6
    centers, ahead = cameras.camera_to_worlds[:, :, 3], -cameras.camera_to_worlds[:, :, 2]
    torch.testing.assert_close(ahead, -centers / centers.norm(dim=-1, keepdim=True))  # to the middle, the origin
    assert bool((centers[:, 2] > 0).all())
    assert float((cameras.camera_to_worlds[:, 2, 1]).min()) > 0.9  # upright


def test_an_orbit_shows_the_same_wherever_the_file_has_its_origin(file: Path) -> None:
    """Red above, blue below, and nothing at the border; the same from a file in other units, at another place."""
    frames = orbit(file, "here")
    assert frames.shape == (3, 50, 50, 3)
    assert (frames[:, 0] == 255).all()
    assert frames[:, 15, 25, 0].min() > 150 > 100 > frames[:, 15, 25, 2].max()
    assert frames[:, 40, 25, 2].min() > 150 > 100 > frames[:, 40, 25, 0].max()
    moved = transformed(ball(), torch.eye(3), 0.2, torch.tensor([-4.0, 1.0, 2.0]))
    write_gaussians(file, moved)
    assert np.abs(orbit(file, "there") - frames).mean() < (1 if file.suffix == ".ply" else 3)  # the others round
    turned = orbit(file, "turned", "--up=-z")
    assert turned[:, 15, 25, 2].min() > 150 > 100 > turned[:, 15, 25, 0].max()


def test_one_format_becomes_another_in_the_frame_of_the_file(file: Path) -> None:
    other = "spz" if file.suffix == ".ply" else "ply"
    done = called("ns-export", "gaussian-splat", file, "--output-dir", file.parent / "out", "--format", other)
    assert done.returncode == 0, done.stderr
    found, given = read_gaussians(file.parent / "out" / f"splat.{other}"), read_gaussians(file)
    assert found.look == given.look
    torch.testing.assert_close(found.gaussians.means, given.gaussians.means, atol=2e-3, rtol=0)
    torch.testing.assert_close(found.gaussians.log_scales, given.gaussians.log_scales, atol=0.07, rtol=0)
    torch.testing.assert_close(found.gaussians.colors, given.gaussians.colors, atol=0.06, rtol=0)


def test_a_page_shows_what_the_file_shows(file: Path) -> None:
    done = called("ns-export", "web", file, "--output-dir", file.parent)
    assert done.returncode == 0, done.stderr
    text = (file.parent / "scene.html").read_text(encoding="utf-8")
    assert len(gaussians_of(text)) == 400
    assert "<title>x</title>" in text
    said = " ".join(done.stderr.split())
    assert "on 5 views around it: PSNR" in said
    assert float(said.partition("around it: PSNR ")[2].split()[0]) > 40


def test_it_is_loaded_and_looked_at_in_python_and_in_the_viewer(file: Path) -> None:
    found = nerfloom.load(file)
    assert isinstance(found.model, nerfloom.Renderable)
    assert not isinstance(found.model, nerfloom.Model)
    torch.testing.assert_close(found.placement.original_points(torch.zeros(1, 3))[0], MIDDLE.double(), atol=0.1, rtol=0)
    camera = around(found.model.scene)[0:1]
    picture = found.render(camera)
    assert picture.size == (800, 800)
    from_outside = float(camera.camera_to_worlds[0, :, 3].norm()) - HALF_WITHIN
    assert float(picture.median_depth[400, 400]) == pytest.approx(from_outside, abs=0.1)
    with pytest.raises(ConfigError, match="its photographs are unknown: give --data DIR"):
        found.views("test")
    pictures, queue = list[np.ndarray](), RenderQueue(found)
    request = Request(Pose(tuple(camera.camera_to_worlds[0].flatten().tolist()), math.radians(50)), 80, 80)
    queue.add(1, Browser(lambda image, quality: pictures.append(image)))
    queue.ask(1, lambda _: request)
    while queue.draw_next() is not None or queue._browsers[1].pieces:
        pass
    expected = found.render(request.camera()).rgb.clamp(0, 1)
    np.testing.assert_allclose(pictures[-1] / 255, expected.cpu().numpy(), atol=0.01)


def test_a_camera_path_is_rendered(file: Path) -> None:
    """Red above and blue below, from a camera in the frame of the scene."""
    pose = around(nerfloom.load(file).model.scene)[0:1].camera_to_worlds[0]
    frame = {"camera_to_world": [*pose.flatten().tolist(), 0, 0, 0, 1], "fov": 50, "aspect": 1}
    path = {"camera_type": "perspective", "render_height": 40, "render_width": 40, "fps": 4, "seconds": 1}
    (file.parent / "path.json").write_text(json.dumps({**path, "camera_path": [frame]}))
    words = ("camera-path", file, "--camera-path-filename", file.parent / "path.json")
    assert called("ns-render", *words, "--output-path", file.parent / "path").returncode == 0
    shown = iio.imread(file.parent / "path" / "00000.png").astype(float)
    assert shown[12, 20, 0] > 150 > 100 > shown[12, 20, 2]
    assert shown[32, 20, 2] > 150 > 100 > shown[32, 20, 0]


def test_what_needs_photographs_is_refused_in_one_line(file: Path, refused: Refused) -> None:
    needs = f"{file} is not a run, so that its photographs are unknown: give --data DIR"
    for path in ("interpolate", "spiral", "time", "dataset"):
        assert refused(render_command.main, path, file, "--output-path", file.parent / "out").endswith(needs)
    assert refused(eval_command.main, file).endswith(needs)
    packages = pytest.importorskip("trimesh") is not None
    for what in ("cameras", *(("pointcloud", "tsdf") if packages else ())):
        assert refused(export_command.main, what, file, "--output-dir", file.parent).endswith(needs), what
    for what, lacks in (("marching-cubes", "has no density"), ("occupancy", "has no occupancy grid")):
        assert lacks in refused(export_command.main, what, file, "--output-dir", file.parent)
    said = refused(eval_command.main, file, "--data", file.parent, "--up", "x")
    assert "--up has no effect with --data" in said
