"""An octree is looked at, judged and exported like a run."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import imageio.v3 as iio
import numpy as np
import pytest
import torch

import nerfloom
from nerfloom.base.errors import ConfigError, DataError
from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.view import View
from nerfloom.cli import bench
from nerfloom.evaluation.error_bound import limited_error
from nerfloom.geometry.points import Points
from nerfloom.kernels.octree.layout import OctreeLayout
from nerfloom.kernels.octree.light import OctreeLight
from nerfloom.octrees.drawn import DrawnOctree
from nerfloom.octrees.files import write_octree
from nerfloom.octrees.packing import packed
from nerfloom.registry import load_dataparser
from tests.cli.helpers import called
from tests.conftest import Refused
from tests.octrees.balls import CELL, RADIUS, ball, boxes
from tests.other_device import OTHER, other_device


def front() -> Cameras:
    """A camera at x = 0, y = -3 that looks along y, z up."""
    pose = torch.tensor([[[1.0, 0, 0, 0], [0, 0, -1, -3], [0, 1, 0, 0]]])
    size = torch.tensor([40])
    length = torch.tensor([60.0])
    return Cameras(pose, length, length, torch.tensor([20.0]), torch.tensor([20.0]), size, size)


def test_a_ball_from_the_front() -> None:
    octree = ball()
    model = DrawnOctree(octree, octree.scene)
    picture = model.render_view(View(front()), model.background)
    assert picture.size == (40, 40)
    torch.testing.assert_close(picture.rgb[0, 0], torch.ones(3))
    torch.testing.assert_close(picture.rgb[15, 20], torch.tensor([0.9, 0.1, 0.1]), atol=0.01, rtol=0)
    torch.testing.assert_close(picture.rgb[24, 20], torch.tensor([0.1, 0.1, 0.9]), atol=0.01, rtol=0)
    assert float(picture.accumulation[20, 20]) > 0.99
    assert float(picture.median_depth[20, 20]) == pytest.approx(3 - RADIUS, abs=2 * CELL)
    assert float(picture.depth[20, 20]) == pytest.approx(3 - RADIUS, abs=2 * CELL)
    assert float(picture.median_depth[0, 0]) == 10
    disc = np.pi * (60 * RADIUS / 3) ** 2
    assert float(picture.accumulation.sum()) == pytest.approx(disc, rel=0.1)
    finer = model.render_view(View(front(), rays_per_pixel=4, stride=2), model.background)
    assert finer.size == (20, 20)
    assert float((finer.rgb - picture.rgb[1::2, 1::2]).abs().mean()) < 0.05


def test_training_does_not_wait_for_the_number_of_leaves_that_rays_meet(monkeypatch: pytest.MonkeyPatch) -> None:
    octree = ball()
    model, rays = DrawnOctree(octree, octree.scene), front().pixel_rays(torch.arange(1600), 0.1, 10.0)
    light = model.light(rays, torch.ones(3), model.early_stop / model.largest)
    expected = model.render(rays, torch.ones(3)).num_samples
    assert isinstance(expected, int)
    with other_device() as mode:
        there = OctreeLight(*(values.to(OTHER) for values in light))
        monkeypatch.setattr(model, "light", lambda *_: there)
        found = model.render(rays.to(OTHER), torch.ones(3)).num_samples
        assert not mode.waits
        assert int(found) == expected
        with torch.no_grad():
            assert model.render(rays.to(OTHER), torch.ones(3)).num_samples == expected
            assert mode.waits.total() == 2


def test_density_is_that_of_the_leaf() -> None:
    octree = ball(depth=2.0)
    model = DrawnOctree(octree, octree.scene)
    positions = torch.tensor([[0.0, 0, 0], [0.3, 0.1, 0], [0.7, 0, 0], [9.0, 0, 0], [torch.nan, 0, 0]])
    found = model.density(Points(positions))
    torch.testing.assert_close(found, torch.tensor([2 / CELL, 2 / CELL, 0, 0, 0]), rtol=1e-4, atol=0)


def test_density_in_boxes_around_one_another() -> None:
    """Each leaf's depth belongs to its own edge."""
    octree = boxes()
    layout, model = octree.layout, DrawnOctree(octree, octree.scene)
    edges = torch.repeat_interleave(
        torch.tensor([CELL, 2 * CELL, 4 * CELL]), torch.tensor(layout.firsts_of_levels).diff()
    )
    torch.testing.assert_close(model.density(Points(layout.centers())), octree.leaves.depths() / edges)


def test_an_octree_without_leaves_has_no_density() -> None:
    layout, _ = OctreeLayout.build(torch.zeros(3), CELL, (1, 1, 1), torch.zeros(0, 3, dtype=torch.int64))
    octree = replace(ball(), layout=layout, leaves=packed(torch.zeros(0), torch.zeros(0, 3))[0])
    found = DrawnOctree(octree, octree.scene).density(Points(torch.tensor([[0.1, 0.1, 0.1], [9.0, 0, 0]])))
    assert torch.equal(found, torch.zeros(2))


def test_an_error_bound_is_kept() -> None:
    octree = ball(depth=0.4)
    model = DrawnOctree(octree, octree.scene)
    views = []
    for bound in (0.0, 0.1):
        with limited_error(model, bound):
            views.append(model.render_view(View(front()), model.background).rgb)
    assert 0 < float((views[0] - views[1]).abs().max()) < 0.1


@pytest.fixture
def file(tmp_path: Path) -> Path:
    write_octree(tmp_path / "ball.octree", ball())
    return tmp_path / "ball.octree"


def test_it_is_opened_like_a_run(file: Path) -> None:
    loaded = nerfloom.load(file)
    assert not loaded.is_run
    assert float(loaded.render(front()).accumulation.max()) > 0.99
    with pytest.raises(ConfigError, match="photographs are unknown"):
        loaded.evaluate()
    with pytest.raises(ConfigError, match="bake that again"):
        loaded.keep_scale()


@pytest.mark.medium
def test_commands_open_it(file: Path) -> None:
    folder = file.parent / "orbit"
    done = called("ns-render", "orbit", file, "--num-frames", 3, "--downscale-factor", 8, "--output-path", folder)
    assert done.returncode == 0, done.stderr
    frames = np.stack([iio.imread(path) for path in sorted(folder.glob("*.png"))]).astype(float)
    assert (frames[:, 0, 0] == 255).all()
    assert frames.min() < 60
    small, smooth = ("--num-frames", 3, "--downscale-factor", 8, "--rays-per-pixel", 16), file.parent / "smooth"
    done = called("ns-render", "orbit", file, *small, "--output-path", smooth)
    assert done.returncode == 0, done.stderr
    means = np.stack([iio.imread(path) for path in sorted(smooth.glob("*.png"))]).astype(float)
    assert not np.array_equal(means, frames)  # edges are means of sixteen rays; all else is the same
    assert abs(means.mean() - frames.mean()) < 2
    done = called("ns-render", "orbit", file, "--up=z", "--output-path", file.parent)
    assert "an octree knows which way is up" in done.stderr


@pytest.mark.medium
def test_its_pictures_a_second_are_measured(shared_tiny: Path, tmp_path: Path, refused: Refused) -> None:
    """Along the cameras of its data; without data there are none."""
    placement = load_dataparser("blender")().parse(shared_tiny, "train").placement
    file, output = tmp_path / "x.octree", tmp_path / "frames.json"
    write_octree(file, replace(ball(), placement=placement))
    flags = ("--runs", file, "--widths", 20, 30, "--threads", 1, "--pictures", 2, "--output", output)
    assert "its photographs are unknown: give --data DIR" in refused(bench.main, "frames", *flags)
    done = called("ns-bench", "frames", *flags, "--data", shared_tiny)
    assert done.returncode == 0, done.stderr
    rows = json.loads(output.read_text())["frames"]
    assert [(row["method"], row["width"], row["height"]) for row in rows] == [("octree", 20, 20), ("octree", 30, 30)]
    assert all(row["run"].endswith("x.octree") and row["per_second"] > 0 for row in rows)


@pytest.mark.medium
def test_normalised_device_coordinates_are_refused(
    tmp_path: Path, shared_tiny: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    placement = load_dataparser("blender")().parse(shared_tiny, "train").placement
    write_octree(tmp_path / "x.octree", replace(ball(), placement=placement))
    warped = SimpleNamespace(scene=replace(ball().scene, warped=True))
    monkeypatch.setattr("nerfloom.training.file_data.load_dataset", lambda *_: warped)
    with pytest.raises(ConfigError, match="--ndc"):
        nerfloom.load(tmp_path / "x.octree", data=shared_tiny)


@pytest.mark.medium
def test_another_frame_is_refused(file: Path, shared_tiny: Path) -> None:
    with pytest.raises(DataError, match="another frame"):
        nerfloom.load(file, data=shared_tiny)
