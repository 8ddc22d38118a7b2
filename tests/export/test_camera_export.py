"""Cameras of all splits, read back by our own parsers: poses to 1e-6 of the input's."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from nerfloom.base.errors import ConfigError
from nerfloom.base.json_files import read_object
from nerfloom.cameras.cameras import Cameras
from nerfloom.data.parsed_scene import DataParser, ParsedScene
from nerfloom.dataparsers.blender import Blender
from nerfloom.dataparsers.colmap import Colmap, read_images
from nerfloom.dataparsers.colmap_model import read_model
from nerfloom.dataparsers.nerfstudio import Nerfstudio
from nerfloom.dataparsers.reading import read_pose
from nerfloom.export.cameras import PosedFiles, posed_files
from nerfloom.export.colmap_text import images_folder, write_model
from nerfloom.export.transforms import transforms, write_transforms
from nerfloom.geometry.alignment import nearest_rotations
from nerfloom.splats.transform import quaternion
from tests.cli.helpers import train

SPLITS = ("train", "val", "test")


def exported(parser: DataParser, data: Path) -> tuple[PosedFiles, dict[str, ParsedScene]]:
    """The part of a run's export that depends on the data."""
    scenes = {split: parser.parse(data, split) for split in SPLITS}
    return posed_files(scenes, scenes["train"].placement), scenes


def given_poses(file: Path) -> dict[str, Tensor]:
    """Name of each image of a transforms file -> its pose as it stands there, float64."""
    frames = read_object(file)["frames"]
    return {Path(row["file_path"]).stem: read_pose(row, "frame")[:3] for row in frames}


def furthest(found: dict[str, Tensor], given: dict[str, Tensor]) -> float:
    """The largest difference of a number of a pose, positions relative to the cameras' extent."""
    assert set(found) == set(given)
    size = float(torch.stack([pose[:, 3] for pose in given.values()]).abs().max())
    scale = torch.tensor([1, 1, 1, size], dtype=torch.float64)
    return max(float(((found[name] - pose) / scale).abs().max()) for name, pose in given.items())


def assert_round_trip(parser: DataParser, data: Path, given: dict[str, Tensor], folder: Path) -> None:
    """Export as both formats, and read both back."""
    posed, scenes = exported(parser, data)
    write_transforms(folder / "transforms.json", posed, relative=False)
    error = furthest(given_poses(folder / "transforms.json"), given)
    write_model(folder / "sparse" / "0", posed)
    model = read_model(folder / "sparse" / "0")
    read = {Path(name).stem: pose[:3] for name, pose in zip(model.names, model.poses, strict=True)}
    print(f"{data.name}: transforms.json {error:.1e}, COLMAP {furthest(read, given):.1e}")
    assert error < 1e-6
    assert furthest(read, given) < 1e-6

    back = {split: Nerfstudio().parse(folder, split) for split in SPLITS}
    images = read_images(folder, folder / "sparse" / "0", str(images_folder(posed)), "masks", "train")
    for split, scene in scenes.items():
        names = [path.resolve() for path in scene.image_paths]
        again = back[split]
        assert sorted(path.resolve() for path in again.image_paths) == sorted(names)
        order = [[path.resolve() for path in again.image_paths].index(name) for name in names]
        lenses = [torch.zeros(1) if s.cameras.lens is None else s.cameras.lens for s in (scene, again)]
        if lenses[0].any():
            torch.testing.assert_close(lenses[1][order], lenses[0])
        for key in ("fx", "fy", "cx", "cy", "widths", "heights"):
            torch.testing.assert_close(getattr(again.cameras, key)[order], getattr(scene.cameras, key))
        order = [[path.resolve() for path in images.paths].index(name) for name in names]
        numbers = torch.stack([scene.cameras.fx, scene.cameras.fy, scene.cameras.cx, scene.cameras.cy], -1)
        torch.testing.assert_close(images.intrinsics[order].float(), numbers)


def test_blender_cameras(tiny: Path, tmp_path: Path) -> None:
    for split in SPLITS:  # so that names are unique
        file = tiny / f"transforms_{split}.json"
        content = json.loads(file.read_text())
        for frame in content["frames"]:
            old = tiny / f"{frame['file_path']}.png"
            frame["file_path"] = f"./{split}/{split}_{old.stem}"
            old.rename(old.with_name(f"{split}_{old.name}"))
        file.write_text(json.dumps(content))
    given: dict[str, Tensor] = {}
    for split in SPLITS:
        given |= given_poses(tiny / f"transforms_{split}.json")
    assert_round_trip(Blender(scale_factor=0.37), tiny, given, tmp_path / "out")


@pytest.mark.medium
@pytest.mark.data
@pytest.mark.parametrize("name", ["fox", "snowmiku"])
def test_nerfstudio_cameras(name: str, real_data: Path, tmp_path: Path) -> None:
    given = given_poses(real_data / name / "transforms.json")
    assert_round_trip(Nerfstudio(), real_data / name, given, tmp_path / "out")


@pytest.mark.medium
@pytest.mark.data
@pytest.mark.parametrize("name", ["colmap_can", "colmap_desk"])
def test_colmap_cameras(name: str, real_data: Path, tmp_path: Path) -> None:
    model = read_model(real_data / name / "sparse" / "0")
    given = {Path(file).stem: pose[:3] for file, pose in zip(model.names, model.poses, strict=True)}
    assert_round_trip(Colmap(), real_data / name, given, tmp_path / "out")


def test_a_run_trains_on_what_was_exported(shared_tiny: Path, tmp_path: Path) -> None:
    posed, _ = exported(Blender(), shared_tiny)
    write_transforms(tmp_path / "cameras" / "transforms.json", posed, relative=True)
    content = json.loads((tmp_path / "cameras" / "transforms.json").read_text())
    assert [len(content[f"{split}_filenames"]) for split in SPLITS] == [10, 2, 3]
    assert content["frames"][0]["file_path"].startswith("../")
    assert content["camera_model"] == "PINHOLE"
    assert content["fl_x"] == pytest.approx(10 / np.tan(0.35))
    run = train(tmp_path / "cameras", tmp_path, "--max-num-iterations", 5)
    assert "name: nerfstudio" in (run / "config.yml").read_text()


def cameras_of(model: str, lens: list[float] | None, count: int = 2) -> Cameras:
    values = torch.linspace(100, 120, count)
    sizes = torch.full((count,), 64)
    lenses = None if lens is None else torch.tensor(lens).expand(count, -1)
    return Cameras(
        torch.eye(4)[None, :3].repeat(count, 1, 1), values, values, values, values, sizes, sizes, model, lenses
    )


def files_of(cameras: Cameras) -> PosedFiles:
    names = tuple(Path(f"/images/{index}.png") for index in range(len(cameras)))
    poses = cameras.camera_to_worlds.double()
    return PosedFiles(names, poses, cameras, {"train": (0, 1)}, (None, None), torch.tensor([0.0, 0.5]), None, 0.25)


def test_lenses_are_written_as_each_format_names_them(tmp_path: Path) -> None:
    k = [0.1, 0.2, 0.01, 0.02, 0.3, 0.0, 0.0, 0.0, 0.4]
    content = transforms(files_of(cameras_of("opencv", k)), tmp_path, False)
    assert [content[key] for key in ("k1", "k2", "p1", "p2", "k3", "k4")] == pytest.approx(
        [0.1, 0.2, 0.01, 0.02, 0.3, 0.4]
    )
    assert content["frames"][1]["time"] == 0.5
    assert content["frames"][1]["fl_x"] == 120  # which differs between the images, and so is not the file's
    assert "fl_x" not in content
    with pytest.raises(ConfigError, match="r\\^8"):
        write_model(tmp_path / "m", files_of(cameras_of("opencv", k)))
    k = [0.1, 0.2, 0.01, 0.02, 0.3, 0.5, 0.6, 0.7, 0.0]
    content = transforms(files_of(cameras_of("opencv", k)), tmp_path, False)
    assert (content["camera_model"], content["k4"], content["k6"]) == ("FULL_OPENCV", 0.5, pytest.approx(0.7))
    write_model(tmp_path / "m", files_of(cameras_of("opencv", k)))
    assert "FULL_OPENCV 64 64" in (tmp_path / "m" / "cameras.txt").read_text()
    with pytest.raises(ConfigError, match="no format can hold"):
        transforms(files_of(cameras_of("opencv", [*k[:8], 0.1])), tmp_path, False)
    panorama = transforms(files_of(cameras_of("equirectangular", None)), tmp_path, False)
    assert panorama["frames"][0]["fl_x"] == pytest.approx(100 * np.pi)
    plan = transforms(files_of(cameras_of("orthographic", None)), tmp_path, False)
    assert plan["frames"][0]["fl_x"] == 25  # pixels per unit of the input, which is a quarter of a scene unit
    with pytest.raises(ConfigError, match="COLMAP has no orthographic cameras"):
        write_model(tmp_path / "m", files_of(cameras_of("orthographic", None)))


def test_quaternions_are_scipys() -> None:
    turns = Rotation.random(200, random_state=0)
    angles = [Rotation.from_rotvec(np.pi * np.eye(3)[axis]) for axis in range(3)]
    for turn in [*turns, Rotation.identity(), *angles]:
        x, y, z, w = turn.as_quat()
        expected = np.array([w, x, y, z])
        found = quaternion(torch.from_numpy(turn.as_matrix())).numpy()
        assert found[0] >= 0
        assert min(np.abs(found - expected).max(), np.abs(found + expected).max()) < 1e-12


def test_rounded_rotations_become_orthonormal_again() -> None:
    turn = torch.from_numpy(Rotation.random(50, random_state=1).as_matrix())
    found = nearest_rotations(turn.float().double())
    eye = torch.eye(3, dtype=torch.float64).expand(50, 3, 3)
    torch.testing.assert_close(found @ found.transpose(1, 2), eye, atol=1e-13, rtol=0)
    assert float((found - turn).abs().max()) < 1e-7
