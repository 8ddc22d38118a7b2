"""The polycam format: one JSON a camera, y up, the corrected ones where there are any."""

import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from nerfloom.base.errors import DataError
from nerfloom.dataparsers.polycam import Polycam
from tests.dataparsers.captures import CX, CY, FX, FY, HEIGHT, WIDTH, edit, poses, worst_miss, write_images

STAMPS = [str(48_000_000_000 + 33_000_000 * index) for index in range(9)]
ONE = f"keyframes/cameras/{STAMPS[4]}.json"


def write_polycam(folder: Path, kind: str = "") -> Path:
    keyframes = folder / "keyframes"
    write_images(keyframes / f"{kind}images", [f"{stamp}.jpg" for stamp in STAMPS])
    (keyframes / f"{kind}cameras").mkdir()
    for stamp, pose in zip(STAMPS, poses(), strict=True):
        content = {"fx": FX, "fy": FY, "cx": CX, "cy": CY, "width": WIDTH, "height": HEIGHT, "blur_score": 90.0}
        content.update({f"t_{row}{column}": pose[row, column] for row in range(3) for column in range(4)})
        (keyframes / f"{kind}cameras" / f"{stamp}.json").write_text(json.dumps(content))
    return folder


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    return write_polycam(tmp_path / "room")


@pytest.mark.parametrize("orientation", ["up", "pca", "none"])
def test_rays_meet_the_points_that_the_cameras_see(capture: Path, orientation: Any) -> None:
    scene = Polycam(eval_interval=0, orientation_method=orientation).parse(capture, "train")
    worst = worst_miss(scene, poses())
    print(f"rays miss known points by {worst:.1e} of their distance")
    assert worst < 2e-6


def test_y_becomes_z(capture: Path) -> None:
    scene = Polycam(orientation_method="none", center_method="none", auto_scale_poses=False).parse(capture, "val")
    x, y, z = poses()[8, :3, 3]
    np.testing.assert_allclose(scene.cameras.camera_to_worlds[1, :, 3].numpy(), [z, x, y], rtol=1e-6)


def test_corrected_ones_go_first(capture: Path) -> None:
    write_polycam(capture, "corrected_")
    scene = Polycam().parse(capture, "train")
    assert {path.parent.name for path in scene.image_paths} == {"corrected_images"}
    shutil.rmtree(capture / "keyframes" / "corrected_cameras")
    assert {path.parent.name for path in Polycam().parse(capture, "train").image_paths} == {"images"}


def test_depth_goes_with_its_image(capture: Path) -> None:
    assert Polycam().parse(capture, "val").depth_paths is None
    write_images(capture / "keyframes" / "depth", [f"{STAMPS[8]}.png"])
    scene = Polycam().parse(capture, "val")
    assert scene.depth_paths == (None, capture / "keyframes" / "depth" / f"{STAMPS[8]}.png")
    assert scene.depth_unit == 0.001


def test_sizes_that_are_not_stated_are_those_of_the_images(capture: Path) -> None:
    edit(capture, lambda content: content.pop("width"), ONE)
    scene = Polycam(eval_interval=0).parse(capture, "train")
    assert worst_miss(scene, poses()) < 2e-6


def test_missing_images_do_not_shift_poses(capture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (capture / "keyframes" / "images" / f"{STAMPS[3]}.jpg").unlink()
    scene = Polycam(eval_interval=0).parse(capture, "train")
    assert worst_miss(scene, np.delete(poses(), 3, axis=0)) < 2e-6
    assert "1 of 9 images are missing" in capsys.readouterr().err


BAD = {
    "no pose": (lambda c: c.pop("t_12"), "'t_12' is None; it must be a number"),
    "nan pose": (lambda c: c.update(t_03=math.nan), "'t_03' is nan"),
    "scaled pose": (lambda c: c.update(t_00=2.0), "the pose is not rigid"),
    "zero focal length": (lambda c: c.update(fx=0), "'fx' is 0; it must be a number above zero"),
    "no centre": (lambda c: c.pop("cx"), "'cx' is None"),
    "negative height": (lambda c: c.update(height=-3), "'height' is -3; it must be a number above zero"),
    "endless height": (lambda c: c.update(height=1e300), "'height' is 1e.300; it must be from 1"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_content_is_refused_by_name(capture: Path, name: str) -> None:
    change, words = BAD[name]
    edit(capture, change, ONE)
    with pytest.raises(DataError, match=words) as error:
        Polycam().parse(capture, "train")
    assert "\n" not in str(error.value)
    assert f"{STAMPS[4]}.json" in str(error.value)


def test_bad_folders_and_flags(capture: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="--data"):
        Polycam().parse(None, "train")
    with pytest.raises(DataError, match="lacks keyframes/cameras"):
        Polycam().parse(tmp_path, "train")
    with pytest.raises(DataError, match="--depth-unit-scale-factor is 0"):
        Polycam(depth_unit_scale_factor=0).parse(capture, "train")
    for file in (capture / "keyframes" / "cameras").iterdir():
        file.unlink()
    with pytest.raises(DataError, match=r"has no cameras .*; export Polycam's raw data again"):
        Polycam().parse(capture, "train")


def test_images_of_all_splits_are_placed_alike(capture: Path) -> None:
    train, held = Polycam().parse(capture, "train"), Polycam().parse(capture, "val")
    assert train.transform is not None
    assert held.transform is not None
    assert torch.equal(train.transform, held.transform)
    assert train.scale == held.scale
