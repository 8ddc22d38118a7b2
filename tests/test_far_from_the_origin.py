"""Captures in any unit and millions of units from their origin: read, accepted again, exported and read back."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch

from nerfloom import ParsedScene
from nerfloom.blocks.block import Block
from nerfloom.blocks.split import tree_blocks
from nerfloom.cameras.camera_path import read_transforms
from nerfloom.cameras.poses import Placement
from nerfloom.data.dataset import load_dataset
from nerfloom.data.offsets import offset_file, read_offset
from nerfloom.data.ply import read_header, read_points, write_points
from nerfloom.dataparsers.colmap_model import read_model
from nerfloom.dataparsers.nerfstudio import Nerfstudio
from nerfloom.export.cameras import camera_list, posed_files
from nerfloom.export.colmap_text import write_model
from nerfloom.export.mesh import Mesh
from nerfloom.export.mesh_files import decimals, write_mesh
from nerfloom.export.transforms import write_transforms as write_cameras
from nerfloom.registry import load_method
from nerfloom.training.block_plan import BlockPlan, block_placements, positions_of
from nerfloom.training.run import TRANSFORMS, Run, write_transforms
from tests.dataparsers.captures import moved, poses, write_capture

UTM = np.array([512345.678, 5403210.987, 432.1])
"""A place on Earth in metres."""
PLACES = {
    "1e-4": (1e-4, 0 * UTM),
    "1": (1.0, 0 * UTM),
    "1e5": (1e5, 0 * UTM),
    "5e6": (5e6, 0 * UTM),
    "1 at 1e5": (1.0, np.array([1e5, -1e5, 1e5])),
    "1 at 5e6": (1.0, UTM),
    "100 at 5e6": (100.0, UTM),
}
"""Unit, and where it is."""
CAPTURES = pytest.mark.parametrize(("unit", "shift"), PLACES.values(), ids=PLACES)


def within(unit: float) -> float:
    """A thousandth of the unit at most, such as a millimetre of a metre, plus float64's rounding at 5,000,000."""
    return 1e-5 * unit + 1e-8


def true_poses(scene: ParsedScene, unit: float, shift: np.ndarray) -> np.ndarray:
    every = moved(poses(), unit, shift)
    return np.stack([every[int(path.stem)] for path in scene.image_paths])


def run_on(folder: Path, unit: float, shift: np.ndarray) -> Run:
    """A run, as training leaves it, of a capture in some unit and at some place."""
    data = write_capture(folder / "capture", given=moved(poses(), unit, shift))
    run = Run(
        "nerfacto", dataclasses.replace(load_method("nerfacto").config, data=data), "nerfstudio", Nerfstudio(), folder
    )
    write_transforms(run, load_dataset(run.parse("train"), "train"))
    return run


@CAPTURES
def test_cameras_are_those_of_the_capture_at_the_origin(unit: float, shift: np.ndarray, tmp_path: Path) -> None:
    """The scene is the same, and its own account leads back to where the photographs were taken."""
    here = Nerfstudio().parse(write_capture(tmp_path / "here"), "train")
    there = Nerfstudio().parse(write_capture(tmp_path / "there", given=moved(poses(), unit, shift)), "train")
    torch.testing.assert_close(there.cameras.camera_to_worlds, here.cameras.camera_to_worlds, rtol=0, atol=1e-6)
    assert there.scale * unit == pytest.approx(here.scale)
    found = there.placement.original_poses(there.cameras.camera_to_worlds).numpy()
    truth = true_poses(there, unit, shift)
    np.testing.assert_allclose(found[:, :, 3], truth[:, :3, 3], rtol=0, atol=within(unit))
    np.testing.assert_allclose(found[:, :, :3], truth[:, :3, :3], rtol=0, atol=1e-6)


@CAPTURES
def test_a_run_accepts_its_own_data(
    unit: float, shift: np.ndarray, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = run_on(tmp_path, unit, shift)
    before = run.parser.parse(run.config.data, "val").cameras.camera_to_worlds
    capsys.readouterr()
    assert torch.equal(run.parse("val").cameras.camera_to_worlds, before)
    assert capsys.readouterr().err == ""
    given = dataclasses.replace(run.parser, placement=tmp_path / TRANSFORMS)  # type: ignore[type-var]
    torch.testing.assert_close(given.parse(run.config.data, "val").cameras.camera_to_worlds, before, rtol=0, atol=1e-6)


@CAPTURES
def test_blocks_are_those_of_the_capture_at_the_origin(unit: float, shift: np.ndarray, tmp_path: Path) -> None:
    """As of a drone's images in UTM: the run of each block reads the same cameras, by the placement in its file."""

    def blocks_of(folder: Path, given: np.ndarray) -> tuple[list[Block], list[torch.Tensor]]:
        data, parser = write_capture(folder / "capture", given=given), Nerfstudio()
        run = Run(
            "nerfacto", dataclasses.replace(load_method("nerfacto").config, data=data), "nerfstudio", parser, folder
        )
        parsed = parser.parse(data, "train")
        found = tree_blocks(positions_of(parsed), 6, 0.3, 1)
        placements = block_placements(run, parsed, tuple(found))
        BlockPlan("nerfacto", (), tuple(found), placements, folder, "").claim_folder(parsed.placement)
        files = [folder / "runs" / f"{number:03d}" / "placement.json" for number in range(len(found))]
        read = [dataclasses.replace(parser, placement=file).parse(data, "train").cameras for file in files]
        return found, [one.camera_to_worlds[list(block.cameras)] for one, block in zip(read, found, strict=True)]

    here, near = blocks_of(tmp_path / "here", poses())
    there, far = blocks_of(tmp_path / "there", moved(poses(), unit, shift))
    assert len(here) > 1
    assert [block.cameras for block in there] == [block.cameras for block in here]
    for one, other in zip(there, here, strict=True):
        np.testing.assert_allclose(one.center, unit * np.array(other.center) + shift, rtol=0, atol=within(unit))
        assert one.radius == pytest.approx(unit * other.radius, rel=1e-5)
    for seen, expected in zip(far, near, strict=True):
        torch.testing.assert_close(seen, expected, rtol=0, atol=3e-6)


def test_a_scene_that_is_left_where_it_is_is_said_to_be_far(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    left = Nerfstudio(center_method="none", auto_scale_poses=False, orientation_method="none")
    for name, shift, far in (("here", 0 * UTM, False), ("there", UTM, True)):
        data = write_capture(tmp_path / name, given=moved(poses(), 1.0, shift))
        capsys.readouterr()
        left.parse(data, "train")
        said = " ".join(capsys.readouterr().err.split())
        assert ("0.32 scene units: --center-method poses" in said) == far
        left.parse(data, "val")
        assert capsys.readouterr().err == ""


def test_placements_that_were_rounded_to_float32_are_still_read(tmp_path: Path) -> None:
    """Placements of earlier runs, and nerfstudio's, put cameras in place, and exports lead back to the input."""
    run = run_on(tmp_path, 1.0, UTM)
    recorded = read_transforms(tmp_path / TRANSFORMS)
    rounded = {"transform": recorded.transform.float().tolist(), "scale": recorded.scale}
    (tmp_path / TRANSFORMS).write_text(json.dumps(rounded))
    scene = run.parse("train")
    kept = Placement.of(recorded.transform.float(), recorded.scale)  # as a checkpoint holds it
    truth = torch.from_numpy(true_poses(scene, 1.0, UTM))
    torch.testing.assert_close(scene.cameras.camera_to_worlds, kept.poses(truth).float(), rtol=0, atol=1e-6)
    found = kept.original_poses(kept.poses(truth))
    torch.testing.assert_close(found[:, :, 3], truth[:, :3, 3], rtol=0, atol=1e-6)


def test_a_placement_is_what_a_checkpoint_holds() -> None:
    rows = np.concatenate([np.eye(3), -UTM[:, None]], axis=1).tolist()
    for held in (rows, torch.tensor(rows, dtype=torch.float64)):
        assert Placement.of(held, 2.0).transform.tolist() == rows
    assert torch.equal(Placement.of(torch.tensor(rows), 2.0).transform, torch.tensor(rows).double())
    assert Placement.of(None, 2.0).points(torch.ones(1, 3)).tolist() == [[2.0, 2.0, 2.0]]


def test_points_and_the_cube_of_a_file_are_where_its_cameras_are(tmp_path: Path) -> None:
    """`offset` and `scale` map the file's positions to a unit cube; UTM coordinates make the offset large."""
    points = torch.from_numpy(UTM) + torch.tensor([[0.5, 0.25, -0.125], [0.0, 0.0, 0.0], [-1.0, 0.5, 0.25]])
    scale = 0.25
    offset = (0.5 - scale * UTM).tolist()  # the middle of the cube is where the capture is
    data = write_capture(
        tmp_path / "capture", given=moved(poses(), 1.0, UTM), ply_file_path="points.ply", aabb_scale=1,
        scale=scale, offset=offset,
    )  # fmt: skip
    write_points(data / "points.ply", points, torch.full_like(points, 0.5))
    scene = Nerfstudio().parse(data, "train")
    assert scene.points is not None
    back = scene.placement.original_points(scene.points)
    torch.testing.assert_close(back, points, rtol=0, atol=1e-5)
    middle = scene.placement.original_points(scene.box.double().mean(0, keepdim=True))[0]
    np.testing.assert_allclose(middle.numpy(), UTM, rtol=0, atol=1e-5)


@CAPTURES
def test_exported_cameras_and_points_are_read_back(unit: float, shift: np.ndarray, tmp_path: Path) -> None:
    data = write_capture(tmp_path / "capture", given=moved(poses(), unit, shift))
    scenes = {split: Nerfstudio().parse(data, split) for split in ("train", "val")}  # type: ignore[arg-type]
    train = dataclasses.replace(scenes["train"], points=torch.tensor([[0.25, -0.5, 0.125], [0.0, 0.0, 0.0]]))
    scenes = {**scenes, "train": train}
    posed = posed_files(scenes, train.placement)
    truth = {path.name: pose for path, pose in zip(posed.files, posed.poses.numpy(), strict=True)}
    every = moved(poses(), unit, shift)
    for name, pose in truth.items():
        np.testing.assert_allclose(pose[:, 3], every[int(name[:3]), :3, 3], rtol=0, atol=within(unit))
    listed = camera_list(train.cameras, [path.name for path in train.image_paths], train.placement)
    for row in json.loads(json.dumps(listed)):
        np.testing.assert_array_equal(row["transform"], truth[row["file_path"]])

    write_cameras(tmp_path / "nerfstudio" / "transforms.json", posed, relative=True)
    again = Nerfstudio().parse(tmp_path / "nerfstudio", "train")
    torch.testing.assert_close(again.cameras.camera_to_worlds, train.cameras.camera_to_worlds, rtol=0, atol=1e-5)
    assert again.points is not None
    found = again.placement.original_points(again.points)
    torch.testing.assert_close(found, train.placement.original_points(train.points), rtol=0, atol=within(unit))  # type: ignore[arg-type]

    write_model(tmp_path / "colmap", posed)
    model = read_model(tmp_path / "colmap")
    for name, pose in zip(model.names, model.poses.numpy(), strict=True):
        np.testing.assert_allclose(pose[:3, 3], truth[name][:, 3], rtol=0, atol=within(unit))
        np.testing.assert_allclose(pose[:3, :3], truth[name][:, :3], rtol=0, atol=1e-9)


def ball(unit: float, shift: np.ndarray) -> Mesh:
    """An octahedron with normals and colours."""
    corners = torch.cat([torch.eye(3), -torch.eye(3)]).double()
    faces = [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]]
    vertices = unit * corners / 3 + torch.from_numpy(shift)
    return Mesh(vertices, torch.tensor(faces), corners.float(), (corners.float() + 1) / 2)


@CAPTURES
def test_points_are_double_where_float_is_too_coarse(
    unit: float, shift: np.ndarray, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    points = ball(unit, shift).vertices
    write_points(tmp_path / "points.ply", points, torch.full_like(points, 0.5))
    kinds = dict(read_header(tmp_path / "points.ply").elements["vertex"].columns)
    found, said = read_points(tmp_path / "points.ply"), " ".join(capsys.readouterr().err.split())
    if shift.any():
        assert kinds["x"] == kinds["y"] == kinds["z"] == "f8"
        assert torch.equal(found, points)
        assert "points.ply: " in said
    else:
        assert kinds["x"] == "f4"
        assert torch.equal(found, points.float().double())
        assert said == ""


@pytest.mark.parametrize("kind", ["ply", "obj", "glb"])
@CAPTURES
def test_meshes_are_read_back(
    unit: float, shift: np.ndarray, kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trimesh = pytest.importorskip("trimesh")
    mesh, file = ball(unit, shift), tmp_path / f"ball.{kind}"
    write_mesh(file, mesh)
    said = " ".join(capsys.readouterr().err.split())
    read = trimesh.load(file, process=False, force="mesh")
    found = np.array(read.vertices) + read_offset(file).numpy()
    np.testing.assert_allclose(found, mesh.vertices.numpy(), rtol=0, atol=1e-6 * unit + 1e-8)
    np.testing.assert_array_equal(np.array(read.faces), mesh.faces.numpy())
    np.testing.assert_allclose(read.vertex_normals, mesh.normals.numpy(), rtol=0, atol=1e-6)  # type: ignore[union-attr]
    assert offset_file(file).exists() == (kind == "glb" and shift.any())
    assert bool(said) == shift.any()
    if kind == "glb" and shift.any():
        write_mesh(file, ball(unit, 0 * shift))  # without an offset; it must not get the earlier one
        assert not offset_file(file).exists()


def test_text_has_decimals_for_small_meshes() -> None:
    assert [decimals(ball(unit, 0 * UTM).vertices) for unit in (1e4, 1.5, 1.5e-2, 1.5e-4)] == [8, 8, 9, 11]
    assert decimals(torch.zeros(4, 3)) == 8
