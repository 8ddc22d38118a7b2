"""camera_path.json: nerfstudio's conventions worked out again, written files are read, and faults are refused."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from nerfloom import DataError
from nerfloom.cameras.camera_path import CameraPath, Keyframe, read_camera_path, read_transforms, write_camera_path
from nerfloom.cameras.poses import Placement
from nerfloom.dataparsers.nerfstudio import Nerfstudio
from tests.dataparsers.captures import poses as captured_poses
from tests.dataparsers.captures import to_scene, write_capture


def turned(angle: float, x: float = 0.5, y: float = -1.0, z: float = 2.0) -> np.ndarray:
    """A pose (4, 4) that is turned about x and then z."""
    c, s = math.cos(angle), math.sin(angle)
    about_x, about_z = np.array([[1, 0, 0], [0, c, -s], [0, s, c]]), np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = about_z @ about_x, (x, y, z)
    return pose


def viewers_file(**changes: Any) -> dict[str, Any]:
    """The file of nerfstudio's viewer for two keyframes and three frames, by the keys of its render panel."""
    frames = [
        {"camera_to_world": turned(0.1 * i).flatten().tolist(), "fov": 50.0 + i, "aspect": 16 / 9} for i in range(3)
    ]
    keyframes = [
        {
            "matrix": turned(0.2 * i).flatten().tolist(), "fov": 75.0, "aspect": 1.77,
            "override_transition_enabled": False, "override_transition_sec": None,
        }
        for i in range(2)
    ]  # fmt: skip
    content = {
        "default_fov": 75.0, "default_transition_sec": 2.0, "keyframes": keyframes, "camera_type": "perspective",
        "render_height": 90, "render_width": 160, "fps": 24, "seconds": 0.125, "is_cycle": False,
        "smoothness_value": 0.5, "camera_path": frames,
    }  # fmt: skip
    return {**content, **changes}


def read(folder: Path, content: Any) -> CameraPath:
    (folder / "path.json").write_text(content if isinstance(content, str) else json.dumps(content))
    return read_camera_path(folder / "path.json")


def directions(path: CameraPath, camera: int, column: float, row: float) -> np.ndarray:
    """Direction of the ray through a place of the image, its corner being (0, 0)."""
    cameras = path.cameras()
    rays = cameras.rays(torch.tensor([camera]), torch.tensor([column - 0.5]), torch.tensor([row - 0.5]), 0.0, 1.0)
    np.testing.assert_allclose(rays.origins[0].numpy(), path.poses[camera, :, 3].numpy(), atol=1e-6)
    return rays.directions[0].numpy()


@pytest.mark.parametrize("kind", ["perspective", "fisheye", "equirectangular"])
def test_rays_are_those_of_nerfstudio(kind: str, tmp_path: Path) -> None:
    """Its formulas: get_path_from_json for focal lengths, and Cameras._generate_rays_from_coords for directions."""
    path = read(tmp_path, viewers_file(camera_type=kind))
    assert (len(path), path.width, path.height) == (3, 160, 90)
    for camera, column, row in ((0, 80.0, 45.0), (1, 10.0, 20.0), (2, 133.0, 71.0)):
        focal = 45 / math.tan(math.radians(50.0 + camera) / 2)
        if kind == "equirectangular":
            x, y = (column - 80) / 80, -(row - 45) / 90  # fx is half the width, fy the height; y up
            theta, phi = -math.pi * x, math.pi * (0.5 - y)
            local = np.array([-math.sin(theta) * math.sin(phi), math.cos(phi), -math.cos(theta) * math.sin(phi)])
        else:
            x, y = (column - 80) / focal, -(row - 45) / focal
            theta = math.hypot(x, y)
            if kind == "fisheye" and theta > 0:
                local = np.array([x * math.sin(theta) / theta, y * math.sin(theta) / theta, -math.cos(theta)])
            else:
                local = np.array([x, y, -1.0])
        expected = turned(0.1 * camera)[:3, :3] @ local
        found = directions(path, camera, column, row)
        np.testing.assert_allclose(found, expected / np.linalg.norm(expected), atol=2e-6)


def test_what_is_written_is_read(tmp_path: Path) -> None:
    poses = torch.from_numpy(np.stack([turned(0.3 * i)[:3] for i in range(4)]))
    path = CameraPath(
        "fisheye",
        64,
        48,
        poses,
        torch.tensor([60.0, 61, 62, 63.25], dtype=torch.float64),
        seconds=1.5,
        times=torch.tensor([0.0, 0.25, 0.5, 1.0]),
        is_cycle=True,
        smoothness_value=0.25,
        keyframes=(Keyframe(poses[0], 60.0, 0.25, 2.0), Keyframe(poses[3], 70.0)),
        placement=Placement(torch.from_numpy(turned(1.0)[:3]), 0.125),
    )
    write_camera_path(tmp_path / "path.json", path)
    back = read_camera_path(tmp_path / "path.json")
    for name in ("camera_type", "width", "height", "seconds", "is_cycle", "smoothness_value", "has_crop", "fps"):
        assert getattr(back, name) == getattr(path, name)
    for name in ("poses", "fovs", "times"):
        assert torch.equal(getattr(back, name), getattr(path, name))
    assert back.placement is not None
    assert path.placement is not None
    assert torch.equal(back.placement.transform, path.placement.transform)
    assert back.placement.scale == path.placement.scale
    for one, other in zip(back.keyframes, path.keyframes, strict=True):
        assert (one.fov, one.time, one.transition) == (other.fov, other.time, other.transition)
        assert torch.equal(one.pose, other.pose)
    assert [file.name for file in tmp_path.iterdir()] == ["path.json"]


def nerfstudio_placement(poses: np.ndarray) -> tuple[np.ndarray, float]:
    """nerfstudio's auto_orient_and_center_poses (up, poses) and auto_scale_poses, from their description."""
    up = poses[:, :3, 1].mean(0)
    up /= np.linalg.norm(up)
    z = np.array([0.0, 0.0, 1.0])
    cross, cosine = np.cross(up, z), up @ z
    skew = np.array([[0, -cross[2], cross[1]], [cross[2], 0, -cross[0]], [-cross[1], cross[0], 0]])
    rotation = np.eye(3) + skew + skew @ skew / (1 + cosine)
    moved = (poses[:, :3, 3] - poses[:, :3, 3].mean(0)) @ rotation.T
    return rotation, 1 / float(np.abs(moved).max())


def test_a_path_of_nerfstudios_viewer_lands_right_in_a_capture(tmp_path: Path) -> None:
    """The camera of the first photograph, saved by a viewer that places the capture as nerfstudio does."""
    scene = Nerfstudio().parse(write_capture(tmp_path / "capture"), "train")
    given = captured_poses()
    rotation, scale = nerfstudio_placement(given)
    placed = given.copy()
    placed[:, :3, :3] = rotation @ given[:, :3, :3]
    placed[:, :3, 3] = scale * (given[:, :3, 3] - given[:, :3, 3].mean(0)) @ rotation.T
    frames = [{"camera_to_world": pose.flatten().tolist(), "fov": 40.0, "aspect": 1.0} for pose in placed]
    path = read(tmp_path, viewers_file(camera_path=frames, seconds=1.0))
    trained = [int(file.stem) for file in scene.image_paths]
    torch.testing.assert_close(path.cameras().camera_to_worlds[trained], scene.cameras.camera_to_worlds)


def test_a_path_fits_a_run_that_is_placed_in_another_way(tmp_path: Path) -> None:
    """The pixel of a point of the input stays the same."""
    folder = write_capture(tmp_path / "capture")
    one, other = (Nerfstudio(orientation_method=way).parse(folder, "train") for way in ("up", "none"))  # type: ignore[arg-type]
    assert one.transform is not None
    assert other.transform is not None
    assert not torch.allclose(one.transform, other.transform, atol=1e-2)
    path = CameraPath(
        "perspective", 40, 30, one.cameras.camera_to_worlds.double(), torch.full((len(one.cameras),), 40.0), 1.0,
        keyframes=(Keyframe(one.cameras.camera_to_worlds[1].double(), 40.0),),
        placement=Placement(one.transform, one.scale),
    )  # fmt: skip
    write_camera_path(tmp_path / "path.json", path)
    moved = read_camera_path(tmp_path / "path.json").placed(Placement(other.transform, other.scale))
    torch.testing.assert_close(moved.poses.float(), other.cameras.camera_to_worlds)
    torch.testing.assert_close(moved.keyframes[0].pose.float(), other.cameras.camera_to_worlds[1])
    point = np.array([[0.2, 0.3, 0.6]])
    pixels = [
        torch.stack(cameras.project(to_scene(scene, point).float(), 2)[:2])
        for cameras, scene in ((path.cameras(), one), (moved.cameras(), other))
    ]
    torch.testing.assert_close(pixels[0], pixels[1], atol=1e-3, rtol=0)


def test_the_first_viewers_files_and_what_is_optional(tmp_path: Path) -> None:
    text = [{"matrix": "[1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1]", "properties": "[]"}]
    content = viewers_file(keyframes=text, crop={"crop_center": [0, 0, 0]})
    for name in ("camera_type", "smoothness_value", "is_cycle", "default_fov"):
        del content[name]
    path = read(tmp_path, content)
    assert (path.camera_type, path.keyframes, path.has_crop) == ("perspective", (), True)
    del content["seconds"]
    assert read(tmp_path, content).fps == pytest.approx(24)
    nested = viewers_file(camera_path=[{"camera_to_world": turned(0.5).tolist(), "fov": 50}], seconds=1)
    np.testing.assert_allclose(read(tmp_path, nested).poses[0].numpy(), turned(0.5)[:3])
    times = [{**frame, "render_time": t} for frame, t in zip(content["camera_path"], (-0.01, 0.5, 1.02), strict=True)]
    assert read(tmp_path, viewers_file(camera_path=times)).times.tolist() == [0.0, 0.5, 1.0]  # type: ignore[union-attr]


def one_frame(**changes: Any) -> dict[str, Any]:
    frame = {"camera_to_world": turned(0.1).flatten().tolist(), "fov": 50.0, "aspect": 1.0, **changes}
    return viewers_file(camera_path=[frame], seconds=0.1)


BAD: dict[str, tuple[Any, str]] = {
    "no json": ("{", "is not JSON"),
    "a list": ([], "must be an object"),
    "no frames": (viewers_file(camera_path=[]), "has 0 frames"),
    "frames of text": (viewers_file(camera_path="none"), "must be a list of cameras"),
    "a frame of text": (viewers_file(camera_path=["none"]), "frame 0 of 'camera_path' is 'none'"),
    "another camera": (viewers_file(camera_type="perspectiv"), "Did you mean 'perspective'"),
    "a camera in both eyes": (viewers_file(camera_type="vr180"), "unknown camera_type 'vr180'. Known: equirectangular"),
    "no height": ({k: v for k, v in viewers_file().items() if k != "render_height"}, "'render_height' is None"),
    "half a pixel": (viewers_file(render_width=100.5), "must be from 1 to 16384 pixels"),
    "a huge image": (viewers_file(render_width=10**9), "must be from 1 to 16384 pixels"),
    "a huge number": (viewers_file(render_width=10**400), "'render_width' is a huge integer"),
    "too many pixels": (viewers_file(render_width=16384, render_height=16384), "too large"),
    "15 numbers": (one_frame(camera_to_world=[0.0] * 15), "a 4x4 matrix, 16 numbers"),
    "17 numbers": (one_frame(camera_to_world=[0.0] * 17), "a 4x4 matrix, 16 numbers"),
    "truth in a pose": (one_frame(camera_to_world=[True, *np.eye(4).flatten().tolist()[1:]]), "a 4x4 matrix"),
    "not a number": (one_frame(camera_to_world=[math.nan] * 16), "not finite"),
    "a mirrored pose": (one_frame(camera_to_world=np.diag([1.0, 1, -1, 1]).flatten().tolist()), "is not rigid"),
    "far away": (one_frame(camera_to_world=turned(0, x=1e12).flatten().tolist()), "farther than 1e+09"),
    "no angle": (one_frame(fov=None), "'fov' is None"),
    "no angle at all": (one_frame(fov=0), "'fov' is 0; it must be from 0.01 to 179 degrees"),
    "half a turn": (one_frame(fov=180), "must be from 0.01 to 179"),
    "an angle of text": (one_frame(fov="50"), "'fov' is '50'"),
    "a shape of nothing": (one_frame(aspect=0), "'aspect' is 0"),
    "no time": (viewers_file(seconds=0), "'seconds' is 0; it must be a number above zero"),
    "endless": (viewers_file(seconds=1e9), "3 frames in 1e+09 seconds"),
    "infinite": (viewers_file(seconds=math.inf), "'seconds' is inf"),
    "some times": (
        viewers_file(camera_path=[*one_frame()["camera_path"], *one_frame(render_time=0)["camera_path"]]),
        "frame 0 of 'camera_path': 'render_time' is None",
    ),
    "a cycle of text": (viewers_file(is_cycle="no"), "'is_cycle' is 'no'; it must be true or false"),
    "a keyframe without pose": (viewers_file(keyframes=[{"fov": 50}]), "'matrix' is None"),
    "no similarity": (viewers_file(placement={"transform": np.eye(3).tolist(), "scale": 1}), "a 4x4 matrix"),
    "no scale": (viewers_file(placement={"transform": np.eye(4)[:3].tolist(), "scale": 0}), "'scale' is 0"),
}  # fmt: skip


@pytest.mark.parametrize(("content", "words"), BAD.values(), ids=BAD.keys())
def test_what_is_wrong_is_refused_in_a_line(content: Any, words: str, tmp_path: Path) -> None:
    with pytest.raises(DataError) as error:
        read(tmp_path, content)
    assert words in str(error.value)
    assert str(tmp_path / "path.json") in str(error.value)
    assert "\n" not in str(error.value)


def test_files_that_are_not_there(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="No such file"):
        read_camera_path(tmp_path / "none.json")
    with pytest.raises(DataError, match="Is a directory"):
        read_transforms(tmp_path)
