"""Shared by all formats of photographs: files reduced beforehand, shapes, recognition of one format a folder."""

import shutil
from importlib import import_module
from pathlib import Path

import pytest
import torch

from nerfloom.base.errors import DataError
from nerfloom.data.dataset import load_dataset
from nerfloom.data.parsed_scene import DataParser
from nerfloom.dataparsers.nerfstudio import Nerfstudio
from tests.conftest import write_tiny
from tests.dataparsers.captures import FX, poses, worst_miss, write_capture, write_images
from tests.dataparsers.test_dtu import write_dtu
from tests.dataparsers.test_polycam import write_polycam
from tests.dataparsers.test_record3d import write_record3d
from tests.dataparsers.test_sdfstudio import write_sdfstudio

NAMES = [f"{index:03d}.png" for index in range(9)]
EXACT = 2e-6


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    return write_capture(tmp_path / "scene")


def test_intrinsics_follow_the_size_of_the_images_that_are_read(capture: Path) -> None:
    """Intrinsics for 40x30 in a folder of images reduced by 2 that are 19x15 do not follow the folder's name."""
    write_images(capture / "images_2", NAMES, 19, 15)
    scene = Nerfstudio(eval_mode="all", downscale_factor=2).parse(capture, "train")
    assert scene.downscale_factor == 1
    assert {path.parent.name for path in scene.image_paths} == {"images_2"}
    assert scene.cameras.fx[0].item() == pytest.approx(FX * 19 / 40)
    assert worst_miss(scene, poses()) < EXACT
    assert load_dataset(scene, "train").image(0).shape == (15, 19, 3)


def test_images_are_reduced_on_loading_where_no_reduced_ones_are(capture: Path) -> None:
    scene = Nerfstudio(downscale_factor=3).parse(capture, "train")
    data = load_dataset(scene, "train")
    assert data.image(0).shape == (10, 13, 3)
    assert data.cameras.fx[0].item() == pytest.approx(FX / 3)


def test_images_reduced_beforehand_are_reduced_on(capture: Path) -> None:
    write_images(capture / "images_2", NAMES, 20, 15)
    scene = Nerfstudio(downscale_factor=4).parse(capture, "train")
    assert scene.downscale_factor == 2
    assert load_dataset(scene, "train").image(0).shape == (7, 10, 3)


def write_alike(folder: Path, width: int, height: int) -> None:
    """Write images for their size alone; encoding each would take most of the time."""
    write_images(folder, NAMES[:1], width, height)
    for name in NAMES[1:]:
        shutil.copy(folder / NAMES[0], folder / name)


@pytest.mark.parametrize(("side", "factor"), [(1600, 1), (1601, 2), pytest.param(3300, 4, marks=pytest.mark.medium)])
def test_images_are_reduced_to_1600_pixels_unless_told(capture: Path, side: int, factor: int) -> None:
    write_alike(capture / "images", side, side * 3 // 4)
    scene = Nerfstudio().parse(capture, "val")
    assert scene.downscale_factor == factor
    assert max(load_dataset(scene, "val").image(0).shape) <= 1600


def test_large_images_are_read_from_the_folder_of_reduced_ones(capture: Path) -> None:
    write_alike(capture / "images", 1640, 1230)
    write_alike(capture / "images_2", 820, 615)
    scene = Nerfstudio().parse(capture, "val")
    assert (scene.image_paths[0].parent.name, scene.downscale_factor) == ("images_2", 1)
    assert worst_miss(scene, poses()[[0, 8]]) < EXACT


def test_a_folder_of_some_reduced_images_is_not_used(capture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Its command was stopped; all originals are there."""
    write_alike(capture / "images", 1640, 1230)
    write_alike(capture / "images_2", 820, 615)
    (capture / "images_2" / NAMES[4]).unlink()
    scene = Nerfstudio(eval_mode="all").parse(capture, "train")
    assert len(scene.image_paths) == len(NAMES)
    assert (scene.image_paths[0].parent.name, scene.downscale_factor) == ("images", 2)
    assert "not all images have one reduced by 2 beside them; these are not used" in capsys.readouterr().err


def test_reduced_images_may_be_all_there_is(capture: Path) -> None:
    """Their endings may differ too, as in LLFF."""
    shutil.rmtree(capture / "images")
    write_images(capture / "images_4", [name.replace("png", "jpg") for name in NAMES], 10, 8)
    scene = Nerfstudio(eval_mode="all").parse(capture, "train")
    assert scene.downscale_factor == 1
    assert worst_miss(scene, poses()) < EXACT
    assert load_dataset(Nerfstudio(downscale_factor=8).parse(capture, "val"), "val").image(0).shape == (4, 5, 3)
    with pytest.raises(DataError, match=r"--downscale-factor 2, .*by 4"):
        Nerfstudio(downscale_factor=2).parse(capture, "train")


def test_masks_are_reduced_with_the_images(capture: Path) -> None:
    import json

    content = json.loads((capture / "transforms.json").read_text())
    for name, frame in zip(NAMES, content["frames"], strict=True):
        frame["mask_path"] = f"masks/{name}"
    (capture / "transforms.json").write_text(json.dumps(content))
    write_images(capture / "masks", NAMES)
    write_images(capture / "images_2", NAMES, 20, 15)
    unreduced = Nerfstudio(downscale_factor=2).parse(capture, "train").mask_paths
    write_images(capture / "masks_2", NAMES, 20, 15)
    reduced = Nerfstudio(downscale_factor=2).parse(capture, "train").mask_paths
    assert unreduced is not None
    assert reduced is not None
    assert {path.parent.name for path in unreduced if path} == {"masks"}
    assert {path.parent.name for path in reduced if path} == {"masks_2"}


def test_another_capture_beside_this_one_is_not_taken_for_reduced_images(tmp_path: Path) -> None:
    """Images in the data folder itself: a folder with the same name and _2 is somebody else's."""
    folder = write_capture(tmp_path / "door")
    for name in NAMES:
        shutil.move(folder / "images" / name, folder / name)
    text = (folder / "transforms.json").read_text()
    (folder / "transforms.json").write_text(text.replace("images/", ""))
    write_images(tmp_path / "door_2", NAMES, 20, 15)
    scene = Nerfstudio(downscale_factor=2).parse(folder, "train")
    assert {path.parent.name for path in scene.image_paths} == {"door"}


def test_images_may_differ_in_size(capture: Path) -> None:
    write_images(capture / "images", NAMES[:1], 80, 60)
    scene = Nerfstudio(eval_mode="all").parse(capture, "train")
    assert scene.cameras.widths.tolist() == [80] + 8 * [40]
    assert worst_miss(scene, poses()) < EXACT
    (capture / "images" / NAMES[1]).write_bytes(b"no image")
    data = load_dataset(Nerfstudio(eval_mode="all").parse(capture, "train"), "train")
    assert torch.equal(data.cameras.widths, torch.tensor([80] + 7 * [40]))


def formats() -> dict[str, type[DataParser]]:
    """The formats of the project's own list, installed or not."""
    tomllib = pytest.importorskip("tomllib")
    content = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())
    found = {}
    for name, value in content["project"]["entry-points"]["nerfloom.dataparsers"].items():
        module, _, attribute = value.partition(":")
        found[name] = getattr(import_module(module), attribute)
    return found


def test_each_folder_is_recognised_by_one_format(tmp_path: Path) -> None:
    folders = {
        "blender": write_tiny(tmp_path / "blender"),
        "nerfstudio": write_capture(tmp_path / "nerfstudio"),
        "record3d": write_record3d(tmp_path / "record3d"),
        "polycam": write_polycam(tmp_path / "polycam"),
        "dtu": write_dtu(tmp_path / "dtu"),
        "sdfstudio": write_sdfstudio(tmp_path / "sdfstudio"),
    }
    inner = tmp_path / "record3d" / "EXR_RGBD"
    both = {"record3d": write_record3d(tmp_path / "both"), "polycam": write_polycam(tmp_path / "both")}
    write_capture(tmp_path / "both")
    write_capture(tmp_path / "old")
    for expected, folder in [
        *folders.items(),
        ("record3d", inner),
        ("nerfstudio", both["record3d"]),
        ("blender", write_tiny(tmp_path / "old")),
    ]:
        assert [name for name, parser in formats().items() if parser.recognizes(folder)] == [expected], folder
    assert not any(parser.recognizes(tmp_path) for parser in formats().values())


@pytest.mark.data
@pytest.mark.parametrize(
    ("folder", "expected"),
    [
        ("fox", "nerfstudio"),
        ("snowmiku", "nerfstudio"),
        ("record3d_door", "record3d"),
        ("lego", "blender"),
        ("bouncingballs", "dnerf"),
        ("dtu_scan24", "dtu"),
    ],
)
def test_real_folders_are_recognised(real_data: Path, folder: str, expected: str) -> None:
    assert [name for name, parser in formats().items() if parser.recognizes(real_data / folder)] == [expected]
