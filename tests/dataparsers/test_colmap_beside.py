"""The COLMAP model beside a transforms.json gives its images' points, if the file was made from it."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nerfloom import ParsedScene
from nerfloom.data.dataset import load_dataset
from nerfloom.dataparsers.colmap import Colmap
from nerfloom.dataparsers.nerfstudio import Nerfstudio
from tests.dataparsers.captures import edit
from tests.dataparsers.sparse_models import SIZE, Capture, make_capture, misses, write_colmap, write_images

ALL = Nerfstudio(eval_mode="all")
APPLIED = np.array([[1.0, 0.0, 0.0, 0.3], [0.0, 0.0, 1.0, -0.2], [0.0, -1.0, 0.0, 0.1]])
"""Transform from the model's axes, with y down, to the file's, with z up; and a shift."""
SCALE = 1.7
INTRINSICS = {"fl_x": 50.0, "fl_y": 48.0, "cx": 31.0, "cy": 19.0}


@pytest.fixture
def capture() -> Capture:
    return make_capture()


@pytest.fixture
def folder(tmp_path: Path, capture: Capture) -> Path:
    """A data folder as ns-process-data leaves it."""
    write_images(tmp_path / "images", capture.names)
    write_colmap(tmp_path / "colmap" / "sparse" / "0", capture, seen_by=(1, 3, 4, 6))
    return write_transforms(tmp_path, capture)


def write_transforms(folder: Path, capture: Capture, **more: Any) -> Path:
    frames = []
    for name, rotation, translation in zip(capture.names, capture.rotations, capture.translations, strict=True):
        pose = np.eye(4)
        pose[:3, :3] = APPLIED[:, :3] @ (rotation.T * [1, -1, -1])
        pose[:3, 3] = SCALE * (APPLIED[:, :3] @ (-rotation.T @ translation) + APPLIED[:, 3])
        frames.append({"file_path": f"images/{name}", "transform_matrix": pose.tolist()})
    content = {"w": SIZE[0], "h": SIZE[1], **INTRINSICS, "applied_transform": APPLIED.tolist(), "applied_scale": SCALE}
    (folder / "transforms.json").write_text(json.dumps(content | {"frames": frames} | more))
    return folder


def seen(scene: ParsedScene) -> list[str]:
    """Names of the images that see points."""
    return [] if scene.sightings is None else [scene.image_paths[i].name for i in scene.sightings.images.unique()]


def test_pixels_have_the_distances_of_the_points_that_they_show(folder: Path, capture: Capture) -> None:
    """The distances equal the capture's own, and the colmap format's."""
    scene = ALL.parse(folder, "train")
    assert scene.sightings is not None
    assert seen(scene) == ["p01.png", "p03.png", "p04.png", "p06.png"]
    assert len(scene.sightings) == 4 * len(capture.points)
    centers = scene.cameras.camera_to_worlds[:, :, 3]
    for image in (1, 3, 4, 6):
        own = scene.sightings.images == image
        found = (scene.sightings.points[own] - centers[image]).norm(dim=-1) / scene.scale
        local = capture.points @ capture.rotations[image].T + capture.translations[image]
        np.testing.assert_allclose(np.sort(found.numpy()), np.sort(np.linalg.norm(local, axis=-1)), rtol=1e-4)
        at = [
            size * place + middle for size, place, middle in zip((50, 48), capture.seen(image).T, (31, 19), strict=True)
        ]
        assert misses(scene, image, *at, capture.points).max() < 1e-3
    assert scene.points is not None
    assert len(scene.points) == len(capture.points)
    other = Colmap(eval_interval=0).parse(folder, "train")
    assert other.sightings is not None
    ours, theirs = (s.sightings.deviations.sort().values / s.scale for s in (scene, other) if s.sightings is not None)
    np.testing.assert_allclose(ours, theirs, rtol=1e-3)
    known = load_dataset(scene, "train").sparse_depth
    assert known is not None
    assert len(known) > 60


def test_held_out_images_are_not_learned_from(folder: Path) -> None:
    """p00 and p08 are held out by default, and of images 1, 3, 4 and 6 none is."""
    assert seen(Nerfstudio().parse(folder, "train")) == ["p01.png", "p03.png", "p04.png", "p06.png"]
    assert seen(Nerfstudio().parse(folder, "test")) == []
    assert len(seen(Nerfstudio(eval_interval=3).parse(folder, "train"))) == 2


def test_frames_and_images_of_the_model_may_be_others(folder: Path) -> None:
    edit(folder, lambda content: content["frames"].pop(3))
    edit(folder, lambda content: content["frames"].append({**content["frames"][0], "file_path": "images/more.png"}))
    write_images(folder / "images", ["more.png"])
    assert seen(ALL.parse(folder, "train")) == ["p01.png", "p04.png", "p06.png"]


def test_images_may_have_had_other_names(folder: Path, capture: Capture) -> None:
    """ns-process-data writes down the names of the original images."""

    def rename(content: dict[str, Any]) -> None:
        for number, (frame, name) in enumerate(zip(content["frames"], capture.names, strict=True)):
            frame |= {"file_path": f"images/frame_{number:05}.png", "source_path": name}
            (folder / "images" / name).rename(folder / frame["file_path"])

    edit(folder, rename)
    assert seen(ALL.parse(folder, "train")) == [f"frame_{number:05}.png" for number in (1, 3, 4, 6)]


def test_points_of_a_file_stay_those_of_the_file(folder: Path) -> None:
    header = (
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    )
    (folder / "points.ply").write_text(header + "0 0 0\n")
    edit(folder, lambda content: content.update(ply_file_path="points.ply"))
    scene = ALL.parse(folder, "train")
    assert scene.points is not None
    assert len(scene.points) == 1
    assert len(seen(scene)) == 4


def test_a_pose_that_was_changed_since_counts_for_its_image_alone(folder: Path) -> None:
    def turn(content: dict[str, Any]) -> None:
        pose = np.array(content["frames"][3]["transform_matrix"])
        angle = np.radians(0.5)
        pose[:3, :3] @= [[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]]
        content["frames"][3]["transform_matrix"] = pose.tolist()

    edit(folder, turn)
    assert seen(ALL.parse(folder, "train")) == ["p01.png", "p04.png", "p06.png"]


def test_a_model_of_another_reconstruction_is_left_out_and_said_to_be(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_transforms(folder, make_capture(seed=5))
    scene = ALL.parse(folder, "train")
    assert (scene.sightings, scene.points) == (None, None)
    assert "only 0 of 10 images have their pose from transforms.json" in capsys.readouterr().err.replace("\n", " ")


def test_a_damaged_model_is_left_out_and_said_to_be(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "colmap" / "sparse" / "0" / "points3D.txt").write_text("1 x y z\n")
    scene = ALL.parse(folder, "train")
    assert (scene.sightings, scene.points) == (None, None)
    said = capsys.readouterr().err.replace("\n", " ")
    assert "damaged" in said
    assert "without the distances" in said
