"""The record3d format: quaternions, K by columns, and images that go by their number."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from nerfloom.base.errors import DataError
from nerfloom.data.dataset import load_dataset
from nerfloom.dataparsers.record3d import Record3D
from nerfloom.dataparsers.rotations import rotations
from tests.dataparsers.captures import CX, CY, FX, FY, HEIGHT, WIDTH, edit, poses, worst_miss, write_images

COUNT = 12


def quaternion(rotation: np.ndarray) -> list[float]:
    """x, y, z, w of a rotation other than a half turn, from its trace and its antisymmetric part."""
    w = math.sqrt(1 + np.trace(rotation)) / 2
    x, y, z = rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]
    return [float(part) / (4 * w) for part in (x, y, z)] + [w]


def write_record3d(folder: Path) -> Path:
    """An export with images reduced by 2: the file's sizes are the recording's."""
    export = folder / "EXR_RGBD"
    write_images(export / "rgb", [f"{index}.jpg" for index in range(COUNT)], WIDTH // 2, HEIGHT // 2)
    content = {
        "w": WIDTH,
        "h": HEIGHT,
        "K": [FX, 0.0, 0.0, 0.0, FY, 0.0, CX, CY, 1],
        "poses": [quaternion(pose[:3, :3]) + pose[:3, 3].tolist() for pose in poses(COUNT)],
        "fps": 60,
    }
    (export / "metadata.json").write_text(json.dumps(content))
    return folder


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    return write_record3d(tmp_path / "recording")


def test_rays_meet_the_points_that_the_cameras_see(capture: Path) -> None:
    scene = Record3D(eval_interval=0).parse(capture, "train")
    worst = worst_miss(scene, poses(COUNT))
    print(f"rays miss known points by {worst:.1e} of their distance")
    assert worst < 2e-6
    assert [path.name for path in scene.image_paths] == [f"{index}.jpg" for index in range(COUNT)]  # 10 after 9
    assert load_dataset(scene, "train").image(0).shape == (HEIGHT // 2, WIDTH // 2, 3)


def test_the_folder_itself_may_be_named(capture: Path) -> None:
    assert len(Record3D(eval_interval=0).parse(capture / "EXR_RGBD", "train").image_paths) == COUNT


def test_missing_images_do_not_shift_poses(capture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for index in (0, 5):
        (capture / "EXR_RGBD" / "rgb" / f"{index}.jpg").unlink()
    scene = Record3D(eval_interval=0).parse(capture, "train")
    assert worst_miss(scene, np.delete(poses(COUNT), [0, 5], axis=0)) < 2e-6
    assert capsys.readouterr().err.count("2 of 12 images are missing") == 1


def test_no_more_images_than_wanted(capture: Path) -> None:
    scene = Record3D(eval_interval=0, max_images=5).parse(capture, "train")
    assert [int(path.stem) for path in scene.image_paths] == [0, 3, 6, 8, 11]
    assert [int(path.stem) for path in Record3D(max_images=5).parse(capture, "val").image_paths] == [0]


def test_rotations_by_hand() -> None:
    """A quarter turn about z takes x to y; half a turn about x takes y to -y."""
    half = math.sqrt(0.5)
    found = rotations(torch.tensor([[0, 0, half, half], [1.0, 0, 0, 0]]))
    torch.testing.assert_close(found[0], torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]))
    torch.testing.assert_close(found[1], torch.diag(torch.tensor([1.0, -1, -1])))


def pose(index: int, value: Any) -> Any:
    return lambda c: c["poses"][4].__setitem__(index, value)


BAD = {
    "no poses": (lambda c: c.pop("poses"), "'poses' must be a list of camera poses"),
    "short pose": (lambda c: c["poses"][4].pop(), "pose 4: 'poses' is .*; it must be a list of 7 numbers"),
    "nan pose": (pose(5, math.nan), "pose 4: 'poses' is nan"),
    "zero quaternion": (lambda c: c["poses"].__setitem__(4, 7 * [0]), "pose 4 has a quaternion of length 0"),
    "no K": (lambda c: c.pop("K"), "'K' is None; it must be a list of 9 numbers"),
    "singular K": (lambda c: c["K"].__setitem__(0, 0.0), "'K' is .*; it must be an intrinsic matrix"),
    "K by rows": (lambda c: c.update(K=[FX, 0, CX, 0, FY, CY, 0, 0, 1]), "'K' is .* column by column"),
    "no width": (lambda c: c.pop("w"), "'w' is None; it must be a number above zero"),
    "endless width": (lambda c: c.update(w=1e300), "'w' is 1e.300; it must be from 1"),
    "other shape": (lambda c: c.update(w=HEIGHT, h=WIDTH), "is 20x15 pixels, but its camera is for 30x40"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_content_is_refused_by_name(capture: Path, name: str) -> None:
    change, words = BAD[name]
    edit(capture, change, "EXR_RGBD/metadata.json")
    with pytest.raises(DataError, match=words) as error:
        Record3D().parse(capture, "train")
    assert "\n" not in str(error.value)
    assert "EXR_RGBD" in str(error.value)


def test_bad_flags(capture: Path) -> None:
    with pytest.raises(DataError, match="--data"):
        Record3D().parse(None, "train")
    with pytest.raises(DataError, match="--max-images is -1"):
        Record3D(max_images=-1).parse(capture, "train")


@pytest.mark.data
def test_real_recording(real_data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = Record3D().parse(real_data / "record3d_door", "train")
    held = Record3D().parse(real_data / "record3d_door", "val")
    assert (len(scene.image_paths), len(held.image_paths)) == (262, 38)
    assert "4 of 345 images are missing and skipped" in capsys.readouterr().err
    assert scene.cameras.fx[0].item() == pytest.approx(351.0757)
    assert scene.cameras.cx[0].item() == pytest.approx(181.1615)
    assert load_dataset(scene[torch.arange(1)], "train").image(0).shape == (480, 360, 3)
