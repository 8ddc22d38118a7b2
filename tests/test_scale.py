"""The scale of a run: its file, its effect on placements, on all exports, and on files read again."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from nerfloom.base.errors import ConfigError, DataError, FlagError
from nerfloom.cameras.camera_path import CameraPath, read_camera_path, write_camera_path
from nerfloom.cameras.poses import Placement
from nerfloom.cameras.scale import Scale, checked, read_scale, scale_file, write_scale
from nerfloom.runs import load
from nerfloom.splats.files import read_gaussians, write_gaussians
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.look import OURS
from tests.cli.helpers import called, train

METRES = Scale(0.25, "m", 0.01)


def test_a_scale_is_read_as_it_was_written(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "splat.ply"):
        assert read_scale(path) == Scale()
        for scale in (METRES, Scale(0.25, "m", None)):
            write_scale(path, scale)
            assert read_scale(path) == scale
        assert scale_file(path).parent == tmp_path
        write_scale(path, Scale())
        assert not scale_file(path).exists()


@pytest.mark.parametrize(
    "content",
    [
        *("[]", "{}", '{"factor": "1", "unit": "m"}', '{"factor": true, "unit": "m"}', '{"factor": 1, "unit": 3}'),
        *('{"factor": 0, "unit": "m"}', '{"factor": NaN, "unit": "m"}', '{"factor": -1, "unit": "m"}'),
        *('{"factor": 1, "unit": ""}', '{"factor": 1, "unit": "<b>"}', '{"factor": 1e400, "unit": "m"}', "{"),
        *('{"factor": 1, "unit": "m", "relative_error": -1}', '{"factor": 1' + "0" * 400 + ', "unit": "m"}'),
    ],
)
def test_damaged_files_are_refused_by_name(content: str, tmp_path: Path) -> None:
    (tmp_path / "scale.json").write_text(content)
    with pytest.raises(DataError, match=r"scale\.json"):
        read_scale(tmp_path)


@pytest.mark.parametrize("unit", ["", "a" * 21, "m\n", "<script>"])
def test_a_unit_is_a_short_name(unit: str) -> None:
    with pytest.raises(FlagError, match="short name"):
        checked(Scale(1.0, unit), "here")


def test_a_scaled_placement_puts_the_scene_in_the_same_place() -> None:
    turn = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))).Q
    placement = Placement(torch.cat([turn, torch.tensor([[1.0], [2.0], [-3.0]]).double()], -1), 0.7)
    points = torch.tensor([[0.3, -2.0, 5.0], [1.0, 1.0, 1.0]], dtype=torch.float64)
    scaled = METRES.placed(placement)
    torch.testing.assert_close(scaled.points(0.25 * points), placement.points(points))
    back = METRES.unplaced(scaled)
    torch.testing.assert_close(back.transform, placement.transform)
    assert back.scale == pytest.approx(placement.scale)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, shared_tiny: Path) -> Path:
    return train(shared_tiny, tmp_path_factory.mktemp("runs"), "--max-num-iterations", 200)


def exported(run: Path, what: str, name: str, folder: Path) -> Path:
    done = called("ns-export", what, run, "--output-dir", folder)
    assert done.returncode == 0, done.stderr
    return folder / name


def centers(run: Path, folder: Path) -> np.ndarray:
    """Positions of the exported training cameras."""
    rows = json.loads(exported(run, "cameras", "transforms_train.json", folder).read_text())
    return np.array([np.array(row["transform"])[:, 3] for row in rows])


@pytest.mark.medium
def test_a_true_length_scales_all_that_is_exported(run: Path, tmp_path: Path) -> None:
    before = centers(run, tmp_path)
    own = load(run)
    view = own.views("test")[0]
    depth = float(own.render(view).median_depth[10, 10]) * own.unit
    done = called("ns-measure", run, "--scale-points", "0,0,0", "-0.6,0.8,0", 0.25, "--unit", "cm")
    assert done.returncode == 0, done.stderr
    try:
        assert read_scale(run).factor == pytest.approx(0.25)
        assert "0.25 cm" in done.stderr
        np.testing.assert_allclose(centers(run, tmp_path), 0.25 * before, rtol=1e-6)
        scaled = load(run)
        assert float(scaled.render(view).median_depth[10, 10]) * scaled.unit == pytest.approx(0.25 * depth)
        torch.testing.assert_close(scaled.pick(view, 10, 10), 0.25 * own.pick(view, 10, 10))
        assert scaled.measure([0, 0, 0], [-0.15, 0.2, 0]).value == pytest.approx(0.25)
        torch.testing.assert_close(scaled.input_placement.transform, own.placement.transform)
        again = called("ns-measure", run, "--scale-points", "0,0,0", "-0.6,0.8,0", 0.25)
        assert again.returncode == 1
        assert "--forget-scale" in again.stderr  # points would be taken for other ones
        assert "0.25 cm" in called("ns-measure", "--between", "0,0,0", "-0.15,0.2,0", run).stderr
    finally:
        assert called("ns-measure", run, "--forget-scale", True).returncode == 0
    np.testing.assert_allclose(centers(run, tmp_path), before, rtol=1e-6)


@pytest.mark.medium
def test_points_are_given_in_a_photograph(run: Path) -> None:
    """The points are on the ball of radius 1 at the origin."""
    name = f"train/{load(run).dataset('train').names[0]}"
    done = called("ns-measure", run, "--between", "9.5,7", "9.5,12", "--image", name)
    assert done.returncode == 0, done.stderr
    points = [line.split(": ")[-1] for line in done.stderr.splitlines() if f"of {name}" in line]
    assert len(points) == 2
    for point in points:
        assert np.linalg.norm([float(part) for part in point.split(",")]) == pytest.approx(1, abs=0.25)


@pytest.mark.medium
def test_what_cannot_be_measured(run: Path) -> None:
    def said(*words: object) -> str:
        done = called("ns-measure", run, *words)
        assert done.returncode in (1, 2)
        return done.stderr

    assert "x,y,z" in said("--between", "1,2", "3,4,5")
    assert "x,y,z" in said("--between", "1,2,nan", "3,4,5")
    assert "column,row" in said("--between", "1,2,3", "3,4,5", "--image", "r_0.png")
    assert "same" in said("--between", "1,2,3", "1,2,3")
    assert "r_0.png" in said("--between", "1,2", "3,4", "--image", "r_0.pnk")
    assert "such as train/r_0.png" in said("--between", "1,2", "3,4", "--image", "r_0.png")
    assert "no surface" in said("--between", "0,0", "9.5,7", "--image", "train/r_0.png")
    assert "20 x 20 pixels" in said("--between", "20,0", "9.5,7", "--image", "train/r_0.png")
    assert "--between" in said("--image", "train/r_0.png")
    assert "one at a time" in said("--between", "1,2,3", "1,2,4", "--forget-scale", True)
    assert "0 m" in said("--scale-points", "0,0,0", "1,0,0", 0)
    assert not scale_file(run).exists()


def some_splat(file: Path) -> None:
    means = torch.tensor([[0.1, 0.2, 0.3], [-0.2, 0.1, 0.0]])
    turn, light = torch.tensor([[1.0, 0, 0, 0]]).repeat(2, 1), torch.zeros(2, 3)
    gaussians = Gaussians(means, torch.full((2, 3), -2.0), turn, torch.full((2,), 4.0), light, torch.zeros(2, 3, 0))
    write_gaussians(file, gaussians, None, OURS)


@pytest.mark.medium
def test_gaussians_in_another_unit_stand_in_their_data(tmp_path: Path, shared_tiny: Path) -> None:
    file = tmp_path / "splat.ply"
    some_splat(file)
    plain = load(file, data=shared_tiny)
    means = plain.model.gaussians(None).means  # type: ignore[attr-defined]
    write_scale(file, Scale(1 / 3, "m"))
    scaled = load(file, data=shared_tiny)
    torch.testing.assert_close(scaled.model.gaussians(None).means, 3 * means)  # type: ignore[attr-defined]
    with pytest.raises(ConfigError, match="keeps its coordinates"):
        scaled.keep_scale()
    again = exported(file, "gaussian-splat", "splat.ply", tmp_path / "again")
    assert read_scale(again) == Scale(1 / 3, "m")
    torch.testing.assert_close(read_gaussians(again)[0].means, read_gaussians(file)[0].means)


@pytest.mark.medium
def test_a_camera_path_does_not_depend_on_the_scale(run: Path, tmp_path: Path) -> None:
    """A path that was saved before a scale was set leads through the same places after it."""
    loaded = load(run)
    pose = torch.eye(4, dtype=torch.float64)[None, :3]
    path = CameraPath("perspective", 16, 16, pose, torch.tensor([50.0]).double(), 1.0, placement=loaded.input_placement)
    write_camera_path(tmp_path / "path.json", path)
    scaled = loaded.with_scale([0, 0, 0], [1, 0, 0], 0.1)
    torch.testing.assert_close(read_camera_path(tmp_path / "path.json").placed(scaled.input_placement).poses, pose)
