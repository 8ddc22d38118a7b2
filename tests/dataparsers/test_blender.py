"""The Blender format: good data is read as it is, bad data is refused in one line or skipped and counted."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from nerfloom.base.errors import DataError
from nerfloom.base.splits import Split
from nerfloom.data.dataset import load_dataset
from nerfloom.data.image_files import read_image, reduce_image
from nerfloom.dataparsers.blender import Blender
from tests.conftest import EditJson


def test_the_tiny_set_is_read_as_written(tiny: Path) -> None:
    parsed = Blender().parse(tiny, "train")
    data = load_dataset(parsed, "train")
    assert len(data) == 10
    assert data.scene.has_alpha
    assert not data.scene.moving
    assert data.cameras.fx[0].item() == pytest.approx(10 / math.tan(0.35))
    written = json.loads((tiny / "transforms_train.json").read_text())["frames"][3]
    torch.testing.assert_close(data.cameras.camera_to_worlds[3], torch.tensor(written["transform_matrix"])[:3])
    np.testing.assert_array_equal(data.image(3).numpy(), iio.imread(tiny / "train" / "r_3.png"))


def test_scale_moves_cameras_and_box(tiny: Path) -> None:
    plain, scaled = Blender().parse(tiny, "val"), Blender(scale_factor=0.5).parse(tiny, "val")
    torch.testing.assert_close(scaled.cameras.camera_to_worlds[:, :, 3], plain.cameras.camera_to_worlds[:, :, 3] / 2)
    torch.testing.assert_close(scaled.box, plain.box / 2)
    assert (scaled.near, scaled.far, scaled.scale) == (1.0, 3.0, 0.5)


def test_reduced_images_and_cameras_fit(tiny: Path) -> None:
    data = load_dataset(Blender(downscale_factor=2).parse(tiny, "train"), "train")
    assert data.image(0).shape == (10, 10, 4)
    assert data.cameras.fx[0].item() == pytest.approx(5 / math.tan(0.35))
    assert data.cameras.cx[0].item() == pytest.approx(5.0)


def test_reduction_weighs_colour_by_alpha() -> None:
    """One opaque red pixel, one half-transparent green, two transparent white ones."""
    image = np.array([[[200, 0, 0, 255], [0, 100, 0, 128]], [[255, 255, 255, 0], [255, 255, 255, 0]]], dtype=np.uint8)
    total = 255 + 128
    expected = [round(200 * 255 / total), round(100 * 128 / total), 0, round(total / 4)]
    assert reduce_image(image, 2)[0, 0].tolist() == expected


def put(key: str, value: Any) -> Any:
    return lambda c: c.update({key: value})


def frame(**changes: Any) -> Any:
    return lambda c: c["frames"][4].update(changes)


def matrix(change: Any) -> Any:
    def edit(c: dict[str, Any]) -> None:
        change(c["frames"][4]["transform_matrix"])

    return edit


def scale_rotation(m: list[list[float]]) -> None:
    for row in m[:3]:
        row[:3] = [2 * value for value in row[:3]]


BAD = {
    "no frames": (put("frames", []), "transforms_train.json lists no frames"),
    "frames is not a list": (put("frames", {"a": 1}), "lists no frames"),
    "no angle": (lambda c: c.pop("camera_angle_x"), "no focal length, neither 'fl_x' nor 'camera_angle_x'"),
    "zero angle": (put("camera_angle_x", 0.0), "'camera_angle_x' is 0.0"),
    "nan angle": (put("camera_angle_x", math.nan), "'camera_angle_x' is nan"),
    "text angle": (put("camera_angle_x", "wide"), "'camera_angle_x' is 'wide'"),
    "frame is no object": (lambda c: c["frames"].__setitem__(4, 7), "frame 4 is 7; it must be an object"),
    "no file": (lambda c: c["frames"][4].pop("file_path"), "frame 4: 'file_path' is missing"),
    "file is a number": (frame(file_path=3), "frame 4: 'file_path' is missing"),
    "no pose": (lambda c: c["frames"][4].pop("transform_matrix"), "frame 4: 'transform_matrix' is not a 4x4 matrix"),
    "ragged pose": (matrix(lambda m: m[0].pop()), "frame 4: 'transform_matrix' is not a 4x4 matrix"),
    "2x4 pose": (matrix(lambda m: m.__delitem__(slice(2))), r"frame 4: the pose has shape \(2, 4\)"),
    "text in pose": (matrix(lambda m: m[0].__setitem__(0, "x")), "frame 4: 'transform_matrix' is not"),
    "nan pose": (matrix(lambda m: m[0].__setitem__(3, math.nan)), "frame 4: .*not finite"),
    "infinite pose": (matrix(lambda m: m[1].__setitem__(1, math.inf)), "frame 4: .*not finite"),
    "scaled pose": (matrix(scale_rotation), "frame 4: the pose is not rigid"),
    "mirrored pose": (matrix(lambda m: [r.__setitem__(0, -r[0]) for r in m[:3]]), "frame 4: the pose is not rigid"),
    "time on one frame only": (frame(time=0.5), "frame 0: 'time' is None"),
    "time beyond one": (lambda c: [f.update(time=5) for f in c["frames"]], "frame 0: 'time' is 5"),
    "nan time": (lambda c: [f.update(time=math.nan) for f in c["frames"]], "frame 0: 'time' is nan"),
    "text time": (lambda c: [f.update(time="now") for f in c["frames"]], "frame 0: 'time' is 'now'"),
    "true as time": (lambda c: [f.update(time=True) for f in c["frames"]], "frame 0: 'time' is True"),
    "true as angle": (put("camera_angle_x", True), "'camera_angle_x' is True"),
    "huge angle": (put("camera_angle_x", 4.0), "'camera_angle_x' is 4.0"),
    "angle whose tangent is zero": (put("camera_angle_x", 5e-324), "'camera_angle_x' is 5e-324"),
    "angle with an infinite focal length": (put("camera_angle_x", 1e-320), "'camera_angle_x' is 1e-320"),
    "huge whole number in pose": (matrix(lambda m: m[0].__setitem__(3, 10**400)), "frame 4: 'transform_matrix'"),
    "deep pose": (frame(transform_matrix=[[[[1]]]]), "frame 4: the pose has shape"),
    "projective pose": (matrix(lambda m: m.__setitem__(3, [0, 0, 0, 2])), "frame 4: the pose is not rigid"),
    "file is the root": (frame(file_path="/"), "frame 4: 'file_path'"),
    "file name too long for the disk": (frame(file_path="a" * 10_000), "frame 4: 'file_path'"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_json_content_is_refused_by_name(tiny: Path, edit_json: EditJson, name: str) -> None:
    change, words = BAD[name]
    edit_json(change)
    with pytest.raises(DataError, match=words) as error:
        Blender().parse(tiny, "train")
    assert "\n" not in str(error.value)
    assert "transforms_train.json" in str(error.value)


@pytest.mark.parametrize("text", ["", "{", "[1, 2]", '"text"', "\x00\xff", "[" * 100_000])
def test_json_that_is_not_an_object(tiny: Path, text: str) -> None:
    (tiny / "transforms_train.json").write_text(text, encoding="latin-1")
    with pytest.raises(DataError, match=r"transforms_train\.json"):
        Blender().parse(tiny, "train")


def test_missing_images_are_skipped_and_reported_once(tiny: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for index in (2, 5):
        (tiny / "train" / f"r_{index}.png").unlink()
    data = load_dataset(Blender().parse(tiny, "train"), "train")
    assert [name for name in data.names] == [f"r_{i}.png" for i in range(10) if i not in (2, 5)]
    said = capsys.readouterr().err
    assert said.count("images are missing") == 1
    assert "2 of 10 images are missing" in said
    assert "r_2.png" in said


def test_a_split_without_images_is_an_error(tiny: Path) -> None:
    for file in (tiny / "train").glob("*.png"):
        file.unlink()
    with pytest.raises(DataError, match=r"split 'train' has no image.*r_0\.png"):
        Blender().parse(tiny, "train")


def test_unreadable_images_are_skipped_and_counted(tiny: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole = (tiny / "train" / "r_1.png").read_bytes()
    (tiny / "train" / "r_1.png").write_bytes(whole[: len(whole) // 2])
    (tiny / "train" / "r_0.png").write_text("this is no image")
    data = load_dataset(Blender().parse(tiny, "train"), "train")
    assert len(data) == 8
    assert "2 of 10 images are unreadable and skipped" in capsys.readouterr().err
    kept = Blender().parse(tiny, "train").cameras.camera_to_worlds[2]
    torch.testing.assert_close(data.cameras.camera_to_worlds[0], kept)


def test_nothing_readable_is_an_error(tiny: Path) -> None:
    for file in (tiny / "train").glob("*.png"):
        file.write_bytes(b"")
    with pytest.raises(DataError, match="not a readable image"):
        load_dataset(Blender().parse(tiny, "train"), "train")


def test_an_image_of_another_size_is_named(tiny: Path) -> None:
    iio.imwrite(tiny / "train" / "r_6.png", np.zeros((20, 24, 4), dtype=np.uint8))
    with pytest.raises(DataError, match=r"r_6\.png is 24x20 pixels, .* 20x20"):
        load_dataset(Blender().parse(tiny, "train"), "train")


def test_sixteen_bit_images_are_refused(tmp_path: Path) -> None:
    iio.imwrite(tmp_path / "deep.png", np.full((4, 4), 40000, dtype=np.uint16))
    with pytest.raises(DataError, match="8 bits"):
        read_image(tmp_path / "deep.png")


@pytest.mark.parametrize("shape", [(4, 5), (4, 5, 3)])
def test_grey_and_rgb_images_become_opaque(tmp_path: Path, shape: tuple[int, ...]) -> None:
    iio.imwrite(tmp_path / "a.png", np.full(shape, 77, dtype=np.uint8))
    image = read_image(tmp_path / "a.png")
    assert image.shape == (4, 5, 4)
    assert image[0, 0].tolist() == [77, 77, 77, 255]


def test_no_folder_and_bad_flags(tiny: Path) -> None:
    with pytest.raises(DataError, match="--data"):
        Blender().parse(None, "train")
    with pytest.raises(DataError, match="cannot read"):
        Blender().parse(tiny / "nowhere", "train")
    with pytest.raises(DataError, match="--downscale-factor is 0"):
        dataclasses.replace(Blender(), downscale_factor=0).parse(tiny, "train")


@pytest.mark.parametrize(("near", "far"), [(2.0, math.inf), (2.0, 2.0), (-1.0, 6.0), (math.nan, 6.0)])
def test_a_scene_ends_somewhere_behind_its_start(tiny: Path, near: float, far: float) -> None:
    parsed = dataclasses.replace(Blender(), near=near, far=far).parse(tiny, "train")
    with pytest.raises(DataError, match=r"--near .*--far"):
        load_dataset(parsed, "train")


@pytest.mark.medium
@pytest.mark.data
@pytest.mark.parametrize(("split", "count"), [("train", 100), ("val", 25), ("test", 50)])
def test_real_lego(real_data: Path, split: Split, count: int) -> None:
    data = load_dataset(Blender().parse(real_data / "lego", split), split)
    assert len(data) == count
    assert {data.image(index).shape for index in range(count)} == {(400, 400, 4)}
    assert data.scene.has_alpha
