"""The sdfstudio format: meta_data.json in a frame of its own, with the transform to the original one."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from nerfloom.base.errors import DataError
from nerfloom.data.dataset import load_dataset
from nerfloom.dataparsers.sdfstudio import SdfStudio
from nerfloom.training.data_folder import find_data
from tests.dataparsers.captures import (
    CX,
    CY,
    FX,
    FY,
    HEIGHT,
    POINTS,
    WIDTH,
    edit,
    miss,
    poses,
    seen_at,
    to_scene,
    worst_miss,
    write_images,
)

COUNT = 9
SCALE = 200.0
TO_GT = np.eye(4)
TO_GT[:3, :3] = SCALE * Rotation.from_rotvec([0.4, -0.7, 0.3]).as_matrix()
TO_GT[:3, 3] = (-30.0, 15.0, 640.0)
"""Transform from the file's frame to the original one, in millimetres."""
LOW, HIGH = POINTS.min(0) - np.array([0.5, 0.7, 0.9]), POINTS.max(0) + np.array([0.9, 0.7, 0.5])


def write_sdfstudio(folder: Path, **changes: Any) -> Path:
    write_images(folder, [f"{index:06d}_rgb.png" for index in range(COUNT)])
    frames = []
    for index, pose in enumerate(poses(COUNT)):
        mask = np.zeros((HEIGHT, WIDTH), np.uint8)
        mask[2 + index : 20 + index, 5:30] = 255
        iio.imwrite(folder / f"{index:06d}_foreground_mask.png", mask)
        np.save(folder / f"{index:06d}_sensor_depth.npy", np.full((HEIGHT, WIDTH), 1.0 + index, np.float32))
        frames.append(
            {
                "rgb_path": f"{index:06d}_rgb.png",
                "camtoworld": (pose @ np.diag([1.0, -1, -1, 1])).tolist(),
                "intrinsics": [[FX, 1e-5, CX, 0], [0, FY, CY, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
                "mono_depth_path": f"{index:06d}_depth.npy",
                "sensor_depth_path": f"{index:06d}_sensor_depth.npy",
                "foreground_mask": f"{index:06d}_foreground_mask.png",
            }
        )
    box = {"aabb": [LOW.tolist(), HIGH.tolist()], "near": 0.5, "far": 4.5, "radius": 1.0, "collider_type": "near_far"}
    content = {
        "camera_model": "OPENCV", "height": HEIGHT, "width": WIDTH, "has_mono_prior": True, "pairs": "pairs.txt",
        "worldtogt": TO_GT.tolist(), "scene_box": box, "frames": frames, **changes,
    }  # fmt: skip
    (folder / "meta_data.json").write_text(json.dumps(content))
    return folder


def in_gt(points: np.ndarray) -> np.ndarray:
    return points @ TO_GT[:3, :3].T + TO_GT[:3, 3]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_sdfstudio(tmp_path / "scan")


@pytest.mark.parametrize("orientation", ["none", "up"])
def test_rays_meet_the_points_in_the_original_frame(folder: Path, orientation: Any) -> None:
    assert find_data(folder) == find_data(folder / "meta_data.json") == (folder, "sdfstudio")
    scene = SdfStudio(eval_interval=0, orientation_method=orientation).parse(folder, "train")
    placed = to_scene(scene, in_gt(POINTS))
    worst = max(
        miss(scene.cameras, camera, *seen_at(pose, point), target)
        for camera, pose in enumerate(poses(COUNT))
        for point, target in zip(POINTS, placed, strict=True)
    )
    print(f"rays miss known points by {worst:.1e} of their distance")
    assert worst < 2e-6


def test_the_box_is_the_files(folder: Path) -> None:
    """The box is the file's if the scene is not turned, and contains it otherwise. Its longest edge is 2."""
    scene = SdfStudio().parse(folder, "train")
    corners = to_scene(scene, in_gt(np.stack([LOW, HIGH])))
    torch.testing.assert_close(scene.box.double(), corners, rtol=1e-6, atol=1e-6)
    assert float((scene.box[1] - scene.box[0]).max()) == pytest.approx(2)
    turned = SdfStudio(orientation_method="up").parse(folder, "train")
    every = np.array([[x, y, z] for x in (LOW[0], HIGH[0]) for y in (LOW[1], HIGH[1]) for z in (LOW[2], HIGH[2])])
    placed = to_scene(turned, in_gt(every))
    torch.testing.assert_close(turned.box.double(), torch.stack([placed.amin(0), placed.amax(0)]), rtol=1e-6, atol=1e-6)


def test_masks_and_depths_go_with_their_images(folder: Path) -> None:
    scene = SdfStudio().parse(folder, "test")
    assert scene.mask_paths == tuple(folder / f"{index:06d}_foreground_mask.png" for index in (0, 8))
    data = load_dataset(scene, "test", masks="auto")
    assert data.scene.has_alpha
    assert not data.scene.unbounded
    assert data.depths is not None
    ends = data.cameras.offsets.tolist()
    for place, index in enumerate((0, 8)):  # stored in the file's unit; one is SCALE millimetres
        expected = (1.0 + index) * SCALE * scene.scale
        assert data.depths[ends[place]].item() == pytest.approx(expected, rel=1e-3)


def test_what_may_be_missing(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """An image without mask is left out; so is all of the rest that a folder need not have."""
    edit(folder, lambda c: c["frames"][3].pop("foreground_mask"), "meta_data.json")
    assert len(SdfStudio(eval_interval=0).parse(folder, "train").image_paths) == 8
    assert "1 of 9 images have no mask and are skipped, the first 000003_rgb.png" in capsys.readouterr().err
    for frame_key in ("foreground_mask", "sensor_depth_path"):
        edit(folder, lambda c, key=frame_key: [frame.pop(key, None) for frame in c["frames"]], "meta_data.json")
    edit(folder, lambda c: [c.pop(key) for key in ("worldtogt", "scene_box", "width", "height")], "meta_data.json")
    scene = SdfStudio(eval_interval=0).parse(folder, "train")
    assert worst_miss(scene, poses(COUNT)) < 2e-6
    assert (scene.mask_paths, scene.depth_paths, scene.object_distances) == (None, None, None)
    named = "000000_foreground_mask.png"
    edit(folder, lambda c: [frame.update(mask_path=named) for frame in c["frames"]], "meta_data.json")
    assert SdfStudio(eval_interval=0).parse(folder, "train").mask_paths is not None


BAD: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "no frames": (lambda c: c.update(frames=[]), "lists no frames"),
    "another lens": (lambda c: c.update(camera_model="FISHEYE"), "'camera_model' is 'FISHEYE'"),
    "no image": (lambda c: c["frames"][4].pop("rgb_path"), "frame 4: 'rgb_path' is missing"),
    "a word": (lambda c: c["frames"].append("x"), "frame 9 is 'x'"),
    "no pose": (lambda c: c["frames"][4].pop("camtoworld"), "frame 4: 'camtoworld' is not a 4x4 matrix"),
    "nan pose": (lambda c: c["frames"][4]["camtoworld"][0].__setitem__(3, math.nan), "frame 4: the pose holds"),
    "scaled pose": (lambda c: c["frames"][4]["camtoworld"][0].__setitem__(0, 9), "frame 4: the pose is not rigid"),
    "no intrinsics": (lambda c: c["frames"][4].pop("intrinsics"), "frame 4: 'intrinsics' is None"),
    "short intrinsics": (lambda c: c["frames"][4].update(intrinsics=[[1, 2]] * 4), "'intrinsics' is .*list of 4"),
    "zero focal length": (lambda c: c["frames"][4]["intrinsics"][1].__setitem__(1, 0), "frame 4: 'intrinsics' begins"),
    "skew": (lambda c: c["frames"][4]["intrinsics"][0].__setitem__(1, 5), "frame 4 has a skew"),
    "box of one corner": (lambda c: c["scene_box"].update(aabb=[[0, 0, 0]]), "'aabb' is"),
    "flat box": (lambda c: c["scene_box"].update(aabb=[[0, 0, 0], [1, 1, 0]]), "'aabb' is .*corner of a box"),
    "sheared worldtogt": (lambda c: c["worldtogt"][0].__setitem__(0, 900), "'worldtogt', divided by its scale"),
    "zero worldtogt": (lambda c: c.update(worldtogt=[[0] * 4] * 4), "'worldtogt' scales by 0"),
    "a word for worldtogt": (lambda c: c.update(worldtogt="x"), "'worldtogt' is 'x'"),
    "height": (lambda c: c.update(height=-3), "'height' is -3"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_content_is_refused_by_name(folder: Path, name: str) -> None:
    change, words = BAD[name]
    edit(folder, change, "meta_data.json")
    with pytest.raises(DataError, match=words) as error:
        SdfStudio().parse(folder, "train")
    assert "\n" not in str(error.value)
    assert "meta_data.json" in str(error.value)


def test_no_folder() -> None:
    with pytest.raises(DataError, match="--data"):
        SdfStudio().parse(None, "train")
