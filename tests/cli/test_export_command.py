"""ns-export: in the frame and units of the input."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.poses import Placement
from nerfloom.cameras.refinement import PoseRefinement
from nerfloom.cli.export import main
from nerfloom.data.ply import read_points, write_points
from nerfloom.export.cameras import camera_list
from nerfloom.geometry.regions import AXES, Polygon, write_regions
from tests.conftest import Refused
from tests.training.helpers import tiny_trainer


@pytest.fixture(scope="module")
def ball(shared_tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The config of a run that has learnt the ball of radius 1."""
    folder = tmp_path_factory.mktemp("run") / "run"
    trainer = tiny_trainer("instant-ngp", shared_tiny, folder, max_num_iterations=200)
    trainer.train()
    return trainer.folder / "config.yml"


def export(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> None:
    monkeypatch.setattr("sys.argv", ["ns-export", *map(str, arguments)])
    main()


@pytest.mark.medium
def test_points_lie_on_the_ball(ball: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    export(monkeypatch, "pointcloud", "--load-config", ball, "--output-dir", tmp_path, "--num-points", 20_000)
    points = read_points(tmp_path / "point_cloud.ply")
    assert 1_000 < len(points) < 20_000  # the rays beside the ball give none
    distances = points.norm(dim=-1)
    # Half of the light is gone a little behind the surface, which 200 steps on 20 x 20 pixels know to a tenth or so.
    assert float((distances - 1).abs().median()) < 0.15
    assert float((distances - 1).abs().quantile(0.9)) < 0.5


def test_cameras_are_those_of_the_input(
    ball: Path, shared_tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    export(monkeypatch, "cameras", "--load-config", ball, "--output-dir", tmp_path)
    found = {row["file_path"]: row["transform"] for row in json.loads((tmp_path / "transforms_train.json").read_text())}
    given = json.loads((shared_tiny / "transforms_train.json").read_text())["frames"]
    assert len(found) == len(given)
    for frame in given:
        name = Path(frame["file_path"]).name + ".png"
        torch.testing.assert_close(torch.tensor(found[name]), torch.tensor(frame["transform_matrix"])[:3])


@pytest.mark.medium
def test_meshes_are_of_the_ball(ball: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: Refused) -> None:
    trimesh = pytest.importorskip("trimesh")
    given = ("--load-config", ball, "--output-dir", tmp_path)
    for what, kind, flags in (
        ("marching-cubes", "ply", ()),
        ("marching-cubes", "glb", ("--target-num-faces", 1000)),
        ("tsdf", "obj", ("--crop-box=-1.3,-1.3,-1.3,1.3,1.3,1.3",)),
    ):
        export(monkeypatch, what, *given, "--resolution", 32, "--format", kind, "--num-components", 1, *flags)
        options = {"skip_materials": True} if kind == "glb" else {}  # beside a material, trimesh loses these colours
        mesh = trimesh.load(tmp_path / f"mesh.{kind}", process=False, force="mesh", **options)
        assert len(mesh.visual.vertex_colors) == len(mesh.vertices)
        distances = np.linalg.norm(mesh.vertices, axis=1)
        # 200 steps on 20 x 20 pixels are not exact, and no view sees the ball from below.
        assert np.median(np.abs(distances - 1)) < 0.2
        assert len(mesh.faces) > 300
        if "--target-num-faces" in flags:
            assert len(mesh.faces) <= 1000
    small = ("--resolution", 16, "--target-num-faces", 300)
    export(monkeypatch, "marching-cubes", *given, *small, "--format", "obj", "--texture-size", 128)
    read = trimesh.load(tmp_path / "mesh.obj", process=False, force="mesh")
    assert read.visual.uv.shape == (len(read.vertices), 2)
    assert np.asarray(read.visual.material.image).std() > 1
    assert "a PLY file has no texture" in refused(main, "marching-cubes", *given, *small, "--texture-size", 128)
    coarse = (*given, "--resolution", 16)
    assert "never passes 1e+30" in refused(main, "marching-cubes", *coarse, "--isosurface-threshold", 1e30)
    assert "--isosurface-threshold is 0" in refused(
        main, "marching-cubes", *given, "--isosurface-threshold", 0, status=2
    )
    assert "--resolution is 2048" in refused(main, "tsdf", *given, "--resolution", 2048, status=2)
    top = np.array([0.0, 0.0, 1.0])
    export(monkeypatch, "marching-cubes", *given, "--resolution", 24, "--crop-sphere", "0,0,1,0.7")
    cap = trimesh.load(tmp_path / "mesh.ply", process=False, force="mesh")
    assert len(cap.faces) > 30
    assert np.linalg.norm(cap.vertices - top, axis=1).max() < 0.7 + 1e-3
    # A square in the picture of a camera at (0, 0, 5) that looks down; a polygon has no end, so the box is the scene's.
    square = Polygon((0.0, 0.0, 5.0), AXES, ((-0.1, -0.1), (0.1, -0.1), (0.1, 0.1), (-0.1, 0.1)))
    for keep in (True, False):
        write_regions(tmp_path / "square.yaml", [replace(square, keep=keep)])
        export(monkeypatch, "marching-cubes", *given, "--resolution", 24, "--region", tmp_path / "square.yaml")
        x, y, z = trimesh.load(tmp_path / "mesh.ply", process=False, force="mesh").vertices.T
        assert len(x) > 30
        inside = np.maximum(np.abs(x), np.abs(y)) / (5 - z)
        assert (inside.max() < 0.1 + 1e-4) if keep else (inside.min() > 0.1 - 1e-4)
    box = ("--crop-box", "50,50,50,51,51,51")
    assert "no training view sees a surface in the box" in refused(main, "tsdf", *coarse, *box)
    assert "no occupied cell in the box" in refused(main, "marching-cubes", *coarse, *box)


def test_the_grid_and_all_cameras_are_written(ball: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    export(monkeypatch, "occupancy", "--load-config", ball, "--output-dir", tmp_path)
    points = read_points(tmp_path / "occupancy.ply")
    with np.load(tmp_path / "occupancy.npz", allow_pickle=False) as grid:
        assert len(points) == grid["occupied"].sum() > 100
    export(monkeypatch, "cameras", "--load-config", ball, "--output-dir", tmp_path)
    content = json.loads((tmp_path / "nerfstudio" / "transforms.json").read_text())
    assert len(content["frames"]) == 15
    assert all(Path(frame["file_path"]).is_file() for frame in content["frames"])
    assert len((tmp_path / "colmap" / "sparse" / "0" / "images.txt").read_text().splitlines()) == 1 + 2 * 15


def test_placement_is_undone_and_refinement_kept() -> None:
    torch.manual_seed(0)
    turn = torch.linalg.matrix_exp(torch.tensor([[0.0, -0.3, 0.1], [0.3, 0, 0.2], [-0.1, -0.2, 0]]).double())
    placement = Placement(torch.cat([turn, torch.tensor([[1.0], [-2.0], [0.5]]).double()], -1), 0.25)
    points = torch.randn(7, 3).double()
    torch.testing.assert_close(placement.original_points(placement.points(points)), points)
    rotations = torch.linalg.qr(torch.randn(3, 3, 3).double())[0]
    poses = torch.cat([rotations, torch.randn(3, 3, 1).double()], -1)
    torch.testing.assert_close(placement.original_poses(placement.poses(poses)), poses)

    numbers = torch.ones(3)
    cameras = Cameras(placement.poses(poses).float(), *[numbers] * 4, *[numbers.long()] * 2)  # type: ignore[arg-type]
    refinement = PoseRefinement(3)
    torch.nn.init.constant_(refinement.tangents, 0.1)
    refined = replace(cameras, camera_to_worlds=refinement.refined(cameras.camera_to_worlds, training=True))
    listed = camera_list(refined, ["a", "b", "c"], placement)
    moved = torch.tensor([row["transform"] for row in listed])
    # Each camera's centre is moved by 0.1 along each axis of the scene, which is 4 times as much in the input.
    shift = (moved[:, :, 3] - poses[:, :, 3].float()).norm(dim=-1)
    torch.testing.assert_close(shift, torch.full((3,), 4 * 0.1 * math.sqrt(3)), rtol=1e-4, atol=1e-4)
    same = camera_list(cameras, ["a", "b", "c"], placement)
    torch.testing.assert_close(torch.tensor([row["transform"] for row in same]), poses.float(), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("with_normals", [True, False])
def test_written_points_are_read_back(tmp_path: Path, with_normals: bool) -> None:
    positions, colors = torch.randn(50, 3), torch.rand(50, 3)
    write_points(tmp_path / "p.ply", positions, colors, torch.randn(50, 3) if with_normals else None)
    assert torch.equal(read_points(tmp_path / "p.ply"), positions.double())
    size = 50 * (27 if with_normals else 15)
    raw = (tmp_path / "p.ply").read_bytes()
    header = raw[: raw.index(b"end_header\n") + 11]
    assert len(raw) - len(header) == size
    assert (b"property float nx" in header) == with_normals
    last = torch.tensor(list(raw[-3:])).float() / 255
    torch.testing.assert_close(last, colors[-1], atol=0.5 / 255 + 1e-6, rtol=0)


def test_what_cannot_be_exported_is_refused(ball: Path, tmp_path: Path, refused: Refused) -> None:
    given, few = ("--load-config", ball, "--output-dir", tmp_path), ("--num-points", 5000)
    assert "nothing is exported as 'poincloud'. Did you mean 'pointcloud'" in refused(main, "poincloud", *given)
    assert "--num-points must be at least 1" in refused(main, "pointcloud", *given, "--num-points", 0, status=2)
    assert "no training ray ends in a surface" in refused(main, "pointcloud", *given, *few, "--reach", 1e-6)


def test_flags_of_nerfstudio_are_answered(tmp_path: Path, refused: Refused) -> None:
    said = refused(main, "pointcloud", tmp_path, "--output-dir", tmp_path, "--bounding-box-min=-1", status=2)
    assert "--bounding-box-min is of nerfstudio's ns-export; here it is --crop-box X,Y,Z,X,Y,Z" in said


def test_normals_are_turned_and_not_moved() -> None:
    """A wall x = 2 of the scene; the input is turned by a quarter about z."""
    quarter = torch.tensor([[0.0, -1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 7]]).double()
    placement = Placement(quarter, 2.0)
    normal = placement.original_directions(torch.tensor([[1.0, 0, 0]]).double())
    wall = torch.tensor([[2.0, 0, 0], [2.0, 3, 1]]).double()
    along = placement.original_points(wall).diff(dim=0)
    assert float((along @ normal.T).abs().max()) < 1e-12
    assert float(normal.norm()) == pytest.approx(1)
