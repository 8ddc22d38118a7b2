"""Phones' captures with faults: refused in one line that names the file, and nothing is written.

Unusual captures are converted, with a report.
"""

import json
import math
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from nerfloom.base.errors import DataError
from nerfloom.data.ply import write_points
from nerfloom.dataparsers.nerfstudio import Nerfstudio
from nerfloom.processing.kinds import process
from nerfloom.processing.settings import PolycamFlags, Record3DFlags
from tests.dataparsers.captures import POINTS, poses, worst_miss
from tests.dataparsers.test_polycam import STAMPS, write_polycam
from tests.dataparsers.test_record3d import COUNT, write_record3d

Content = dict[str, Any]


def spoil(file: Path, change: Callable[[Content], Any] | str) -> None:
    """Change a JSON file's content, or put a text in its place."""
    content = json.loads(file.read_text())
    if isinstance(change, str):
        file.write_text(change)
    else:
        change(content)
        file.write_text(json.dumps(content))


def convert_polycam(folder: Path, output: Path, most: int = 300) -> None:
    flags = PolycamFlags(data=folder, output_dir=output, num_downscales=0, max_dataset_size=most, crop_border_pixels=0)
    process("polycam", flags)


def convert_record3d(folder: Path, output: Path, most: int = 300, ply: Path | None = None) -> None:
    flags = Record3DFlags(data=folder, output_dir=output, num_downscales=0, max_dataset_size=most, ply=ply)
    process("record3d", flags)


CAMERAS = {
    "deep": "[" * 100_000,
    "a list": "[]",
    "nan pose": lambda c: c.update(t_03=math.nan),
    "huge pose": lambda c: c.update(t_03=10**400),
    "no pose": lambda c: c.pop("t_12"),
    "nan centre": lambda c: c.update(cx=math.nan),
    "no focal length": lambda c: c.update(fx=0.0),
    "endless width": lambda c: c.update(width=math.inf),
    "wide": lambda c: c.update(width=1e300),
    "no width": lambda c: c.update(width=0.5),
    "blur is a word": lambda c: c.update(blur_score="sharp"),
    "blur is nothing": lambda c: c.update(blur_score=None),
}
METADATA = {
    "deep": "[" * 100_000,
    "a list": "[]",
    "nan pose": lambda c: c["poses"][4].__setitem__(5, math.nan),
    "huge pose": lambda c: c["poses"][4].__setitem__(5, 10**400),
    "no rotation": lambda c: c["poses"].__setitem__(4, [0] * 7),
    "a rotation whose square overflows": lambda c: c["poses"].__setitem__(4, [1e200] * 7),
    "nan matrix": lambda c: c["K"].__setitem__(6, math.nan),
    "no focal length": lambda c: c["K"].__setitem__(0, 0),
    "endless width": lambda c: c.update(w=math.inf),
    "no height": lambda c: c.update(h=-3),
    "the front camera": lambda c: c.update(poses=[[0, 0, 0, 1, 0, 0, 0]] * COUNT),
}


@pytest.mark.parametrize("name", CAMERAS)
def test_polycam(name: str, tmp_path: Path) -> None:
    folder = write_polycam(tmp_path / "room")
    file = folder / "keyframes" / "cameras" / f"{STAMPS[4]}.json"
    spoil(file, CAMERAS[name])
    with pytest.raises(DataError, match=file.name):
        convert_polycam(folder, tmp_path / "out")
    assert not (tmp_path / "out" / "transforms.json").exists()


@pytest.mark.parametrize("name", METADATA)
def test_record3d(name: str, tmp_path: Path) -> None:
    folder = write_record3d(tmp_path / "recording")
    spoil(folder / "EXR_RGBD" / "metadata.json", METADATA[name])
    with pytest.raises(DataError, match=r"metadata\.json"):
        convert_record3d(folder, tmp_path / "out")
    assert not (tmp_path / "out" / "transforms.json").exists()


def test_images_of_another_shape(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, reason = write_polycam(tmp_path / "room"), "it has 40x30 pixels, but its camera is for 30x30"
    cameras = folder / "keyframes" / "cameras"
    spoil(cameras / f"{STAMPS[4]}.json", lambda c: c.update(width=c["height"]))
    convert_polycam(folder, tmp_path / "out")
    assert f"1 images do not fit their cameras, the first: {STAMPS[4]}.jpg: {reason}" in " ".join(
        capsys.readouterr().err.split()
    )
    written = json.loads((tmp_path / "out" / "transforms.json").read_text())["frames"]
    assert [Path(frame["source_path"]).stem for frame in written] == [*STAMPS[:4], *STAMPS[5:]]
    assert not (tmp_path / "out" / "images" / f"{STAMPS[4]}.jpg").exists()
    for stamp in STAMPS:
        spoil(cameras / f"{stamp}.json", lambda c: c.update(width=c["height"]))
    with pytest.raises(DataError, match=rf"fits its camera, the first: {STAMPS[0]}\.jpg: {reason}"):
        convert_polycam(folder, tmp_path / "other")


def test_reduced_images_of_record3d(tmp_path: Path) -> None:
    """They are half as large as the file says; where the first camera's up is, nobody knows."""
    folder = write_record3d(tmp_path / "recording")
    convert_record3d(folder, tmp_path / "out")
    content = json.loads((tmp_path / "out" / "transforms.json").read_text())
    assert "orientation_override" not in content
    scene = Nerfstudio(eval_interval=0).parse(tmp_path / "out", "train")
    order = [int(path.stem) for path in scene.image_paths]
    assert sorted(order) == list(range(COUNT))
    worst = worst_miss(scene, poses(COUNT)[order])
    print(f"rays miss known points by {worst:.1e} of their distance")
    assert worst < 2e-6


@pytest.mark.parametrize("away", [0.0, 5000.0])
def test_points_of_record3d_move_with_the_poses(away: float, tmp_path: Path) -> None:
    """Those of all files of a folder or a zip file, also far from the origin."""
    folder, expected = write_record3d(tmp_path / "recording"), POINTS + np.array([0.0, away, 0.0])

    def move(content: Content) -> None:
        for pose in content["poses"]:
            pose[5] += away

    spoil(folder / "EXR_RGBD" / "metadata.json", move)
    (tmp_path / "points").mkdir()
    for number, point in enumerate(expected):
        write_points(
            tmp_path / "points" / f"{number}.ply", torch.from_numpy(point[None]), torch.full((1, 3), 0.25 * number)
        )
    convert_record3d(folder, tmp_path / "out", ply=tmp_path / "points")
    assert json.loads((tmp_path / "out" / "transforms.json").read_text())["ply_file_path"] == "sparse_pc.ply"
    scene = Nerfstudio(eval_interval=0).parse(tmp_path / "out", "train")
    assert scene.points is not None
    found = scene.placement.original_points(scene.points)
    np.testing.assert_allclose(found, expected, atol=1e-5 + 1e-6 * away)
    with pytest.raises(DataError, match="has no PLY file"):
        convert_record3d(folder, tmp_path / "other", ply=folder)
    with zipfile.ZipFile(tmp_path / "points.zip", "w") as archive:
        archive.writestr("__MACOSX/walk/._0.ply", b"no points")
        for file in (tmp_path / "points").iterdir():
            archive.write(file, f"walk/{file.name}")
    convert_record3d(folder, tmp_path / "of zip", ply=tmp_path / "points.zip")
    names = sorted(path.name for path in (tmp_path / "of zip").iterdir())
    assert names == ["images", "sparse_pc.ply", "transforms.json"]
    written = (tmp_path / "out" / "sparse_pc.ply").read_bytes()
    assert (tmp_path / "of zip" / "sparse_pc.ply").read_bytes() == written
    with zipfile.ZipFile(tmp_path / "empty.zip", "w") as archive:
        archive.writestr("readme.txt", b"no points")
    with pytest.raises(DataError, match=r"empty\.zip has no PLY file"):
        convert_record3d(folder, tmp_path / "nothing", ply=tmp_path / "empty.zip")
    assert not (tmp_path / "nothing").exists()


def test_images_that_are_not_taken_are_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    room, recording = write_polycam(tmp_path / "room"), write_record3d(tmp_path / "recording")
    rgb = recording / "EXR_RGBD" / "rgb"
    (rgb / "cover.jpg").write_bytes((rgb / "0.jpg").read_bytes())
    (rgb / "03.jpg").write_bytes((rgb / "3.jpg").read_bytes())
    convert_polycam(room, tmp_path / "a", 4)
    convert_record3d(recording, tmp_path / "b", 5)
    said = " ".join(capsys.readouterr().err.split())
    assert f"4 of {len(STAMPS)} images are taken" in said
    assert f"5 of {COUNT} images are taken" in said
    assert "2 images in" in said
    assert len(json.loads((tmp_path / "b" / "transforms.json").read_text())["frames"]) == 5
