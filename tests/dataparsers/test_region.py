"""Renders of any unit, place and lens: the box holds all matter, and the file's intrinsics are used unchanged.

Matter is balls with known silhouettes: a pixel is opaque if its ray passes a ball by less than its own half
diagonal, as anti-aliasing makes it.
"""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from nerfloom.base.errors import DataError
from nerfloom.base.splits import Split
from nerfloom.cameras.cameras import Cameras
from nerfloom.data.dataset import load_dataset
from nerfloom.data.parsed_scene import ParsedScene
from nerfloom.dataparsers.blender import Blender
from nerfloom.dataparsers.dnerf import DNeRF
from nerfloom.scene.enclosing_box import enclosing_box

BALLS = np.array([[0.2, 0.1, -0.1, 0.5], [-0.5, 0.3, 0.2, 0.25], [0.1, -0.6, 0.4, 0.2]])
"""Centres and radii."""


@dataclass(frozen=True)
class Shot:
    """A rig of cameras, its unit and place, and the lens."""

    unit: float = 1.0
    center: tuple[float, float, float] = (0.0, 0.0, 0.0)
    size: tuple[int, int] = (90, 70)
    focal: tuple[float, float] = (100.0, 100.0)
    middle: tuple[float, float] = (45.0, 35.0)
    k1: float = 0.0
    distance: float = 4.0
    count: int = 24

    @property
    def balls(self) -> np.ndarray:
        """Centres and radii in the file's units."""
        return np.concatenate([BALLS[:, :3] * self.unit + np.array(self.center), BALLS[:, 3:] * self.unit], 1)

    def poses(self, turn: float = 0.0) -> np.ndarray:
        """Cameras on a spiral around the balls."""
        found = []
        for index in range(self.count):
            height = 0.9 - 1.2 * (index + 0.5) / self.count
            angle = turn + 2.4 * index
            back = np.array([math.cos(angle), math.sin(angle), 0]) * math.sqrt(1 - height**2) + [0, 0, height]
            right = np.cross([0, 0, 1.0], back)
            right /= np.linalg.norm(right)
            pose = np.eye(4)
            pose[:3] = np.stack([right, np.cross(back, right), back, self.distance * back * self.unit], 1)
            pose[:3, 3] += np.array(self.center)
            found.append(pose)
        return np.array(found)

    def opaque(self, pose: np.ndarray) -> np.ndarray:
        """Pixels that a ball may be in, (H, W) bool."""
        rows, columns = np.mgrid[: self.size[1], : self.size[0]] + 0.5
        at = np.stack([(columns - self.middle[0]) / self.focal[0], (rows - self.middle[1]) / self.focal[1]], -1)
        plane = at.copy()
        for _ in range(60 if self.k1 else 0):  # p (1 + k1 |p|^2) = at
            plane = at / (1 + self.k1 * (plane**2).sum(-1, keepdims=True))
        local = np.stack([plane[..., 0], -plane[..., 1], -np.ones(rows.shape)], -1)
        rays = local @ pose[:3, :3].T
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        hit = np.zeros(rows.shape, dtype=bool)
        for *center, radius in self.balls:
            to = np.array(center) - pose[:3, 3]
            ahead = rays @ to
            beside = np.sqrt(np.maximum(to @ to - ahead**2, 0))
            hit |= (ahead > 0) & (beside < radius + ahead * (0.72 + 0.2 * abs(self.k1)) / min(self.focal))
        return hit

    def write(self, folder: Path, alpha: bool = True, times: bool = False, **intrinsics: Any) -> Path:
        """transforms_train.json and transforms_test.json as BlenderNeRF writes them, with some values replaced."""
        stated = {
            "camera_angle_x": 2 * math.atan(self.size[0] / 2 / self.focal[0]),
            "camera_angle_y": 0.4711,  # of Blender's sensor
            "fl_x": self.focal[0], "fl_y": self.focal[1], "cx": self.middle[0], "cy": self.middle[1],
            "k1": self.k1, "k2": 0.0, "p1": 0.0, "p2": 0.0, "w": float(self.size[0]), "h": self.size[1],
            "aabb_scale": 4, **intrinsics,
        }  # fmt: skip
        for split, turn in (("train", 0.0), ("test", 0.7)):
            (folder / split).mkdir(parents=True)
            frames = []
            for index, pose in enumerate(self.poses(turn)):
                mask = self.opaque(pose)
                image = np.concatenate([np.full((*mask.shape, 3), 150), mask[..., None] * 255], -1).astype(np.uint8)
                iio.imwrite(folder / split / f"{index:04d}.png", image if alpha else image[..., :3])
                frame = {"file_path": f"{split}/{index:04d}.png", "transform_matrix": pose.tolist()}
                frames.append(frame | ({"time": index / (self.count - 1)} if times else {}))
            content = {name: value for name, value in stated.items() if value is not None} | {"frames": frames}
            (folder / f"transforms_{split}.json").write_text(json.dumps(content))
        return folder


def in_scene(scene: ParsedScene, points: np.ndarray) -> np.ndarray:
    """Points (N, 3) of the file in the scene's frame."""
    transform = np.eye(4)[:3] if scene.transform is None else scene.transform.double().numpy()
    return scene.scale * (points @ transform[:, :3].T + transform[:, 3])


def room_around(scene: ParsedScene, shot: Shot) -> float:
    """How much larger than the balls the box is, in its edge; below 1 if a ball is outside."""
    centers, radii = in_scene(scene, shot.balls[:, :3]), shot.balls[:, 3:] * scene.scale
    low, high = (centers - radii).min(0), (centers + radii).max(0)
    box = scene.box.double().numpy()
    rounding = 1e-6 * (1 + np.abs(np.array(shot.center)).max() / shot.unit)
    assert (box[0] <= low + rounding).all()
    assert (box[1] >= high - rounding).all()
    cameras = scene.cameras.camera_to_worlds[:, :, 3].double().numpy()
    away = np.linalg.norm(cameras[:, None] - centers, axis=-1)
    assert scene.near <= (away - radii.T).min()
    assert scene.far >= (away + radii.T).max()
    return float((box[1] - box[0]).max() / (high - low).max())


ORDINARY = Shot()
SHOTS = {
    "as it is": (ORDINARY, 1.15),
    "a room of 10 m": (Shot(unit=10.0), 1.15),
    "a ring of 2 cm": (Shot(unit=0.005), 1.15),
    "off the origin": (Shot(center=(7.0, -3.0, 2.0)), 1.15),
    "small, and far from the origin": (Shot(unit=0.1, center=(900.0, 0.0, -50.0)), 1.15),
    "near the cameras": (Shot(distance=2.0, focal=(60.0, 60.0)), 1.15),
    "off centre": (Shot(middle=(25.0, 40.0)), 1.15),
    "wide pixels": (Shot(focal=(70.0, 120.0)), 1.15),
    "a bent lens": (Shot(k1=-0.15), 1.25),
    "few": (Shot(count=4), 1.8),
}


@pytest.mark.medium
@pytest.mark.parametrize("name", SHOTS)
def test_the_box_holds_all_matter_and_little_else(name: str, tmp_path: Path) -> None:
    shot, most = SHOTS[name]
    folder = shot.write(tmp_path)
    train, test = (Blender().parse(folder, split) for split in ("train", "test"))
    room = room_around(train, shot)
    room_around(test, shot)
    print(f"{name}: the box is {room:.3f} times as wide as the matter")
    assert 1 <= room < most
    assert not train.unbounded
    assert train.scale == test.scale
    torch.testing.assert_close(train.box, torch.tensor([[-1.5] * 3, [1.5] * 3]))
    if name != "near the cameras":  # cut off nowhere
        assert all(not mask[0].any() and not mask[:, 0].any() for mask in map(shot.opaque, shot.poses()))


def test_matter_that_no_image_shows_as_a_whole_is_in_a_larger_box(tmp_path: Path) -> None:
    """Every image cuts off some of it at the left; there it could be higher than all that is shown."""
    shot = Shot(middle=(12.0, 35.0))
    assert all(shot.opaque(pose)[:, 0].any() for pose in shot.poses())
    scene = Blender().parse(shot.write(tmp_path), "train")
    assert 1 <= room_around(scene, shot) < 4.6
    assert not scene.unbounded  # it ends at the right of all images
    for file in (tmp_path / "train").glob("*.png"):
        image = iio.imread(file)
        image[25:45, :, 3] = 255  # a plane without an end
        iio.imwrite(file, image)
    assert Blender().parse(tmp_path, "train").unbounded


@pytest.mark.medium
@pytest.mark.parametrize("unit", [0.005, 1.0, 10.0])
def test_without_alpha_the_box_is_where_the_cameras_look(unit: float, tmp_path: Path) -> None:
    shot = Shot(unit=unit, center=(3 * unit, 0.0, unit))
    scene = Blender().parse(shot.write(tmp_path, alpha=False), "train")
    assert 1 <= room_around(scene, shot) < 2.7
    assert scene.unbounded  # the images show matter behind, too


@pytest.mark.medium
def test_a_moving_scene_is_where_the_cameras_look_and_ends_there(tmp_path: Path) -> None:
    """Matter may move between times, so silhouettes of different times say nothing together."""
    shot = Shot(unit=3.0, center=(1.0, 2.0, 3.0))
    scene = DNeRF().parse(shot.write(tmp_path, times=True), "train")
    assert 1 <= room_around(scene, shot) < 2.7
    assert not scene.unbounded
    half = 4.0 * 45 / 100 * 1.034 * 3.0
    assert scene.scale == pytest.approx(1.5 / half, rel=1e-3)


def test_cameras_that_look_outwards_take_the_cube_of_the_file_or_one_around_them(tmp_path: Path) -> None:
    shot = Shot(distance=-0.5, count=8)
    folder = shot.write(tmp_path, alpha=False)
    scene = Blender().parse(folder, "train")
    assert scene.scale == pytest.approx(1.5 / (4 / 0.33 / 2))
    assert scene.unbounded
    edit(folder, "train", aabb_scale=None)
    scene = Blender().parse(folder, "train")
    places = scene.cameras.camera_to_worlds[:, :, 3].abs()
    assert float(places.max()) == pytest.approx(1.5)


def edit(folder: Path, split: Split, **values: Any) -> None:
    file = folder / f"transforms_{split}.json"
    content = json.loads(file.read_text()) | values
    file.write_text(json.dumps({name: value for name, value in content.items() if value is not None}))


def test_a_file_states_its_intrinsics(tmp_path: Path) -> None:
    """Also without an angle, for images of half the stated size, and for a frame of its own."""
    shot = Shot(middle=(25.0, 40.0), focal=(70.0, 120.0), k1=0.05, count=3)
    folder = shot.write(tmp_path, camera_angle_x=None, w=180, h=140, fl_x=140.0, fl_y=240.0, cx=50.0, cy=80.0)
    file = folder / "transforms_train.json"
    content = json.loads(file.read_text())
    content["frames"][1] |= {"fl_x": 160.0, "cx": 60.0, "k1": 0.1}
    file.write_text(json.dumps(content))
    cameras = Blender().parse(folder, "train").cameras
    assert cameras.fx.tolist() == [70.0, 80.0, 70.0]
    assert cameras.fy.tolist() == [120.0] * 3
    assert cameras.cx.tolist() == [25.0, 30.0, 25.0]
    assert cameras.cy.tolist() == [40.0] * 3
    assert cameras.model == "opencv"
    assert cameras.lens is not None
    torch.testing.assert_close(cameras.lens[:, 0], torch.tensor([0.05, 0.1, 0.05]))


def test_contradictions(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = Shot(count=3).write(tmp_path)
    Blender().parse(folder, "train")
    assert "fl_x" not in capsys.readouterr().err
    edit(folder, "train", camera_angle_x=1.2)
    assert Blender().parse(folder, "train").cameras.fx.tolist() == [100.0] * 3
    said = capsys.readouterr().err
    assert "'fl_x' is 100, but 'camera_angle_x' gives 65.7763 for a width of 90 pixels; using fl_x" in said
    Blender().parse(folder, "test")
    assert "camera_angle_x" not in capsys.readouterr().err
    edit(folder, "train", w=70, h=90)
    with pytest.raises(DataError, match=r"0000\.png is 90x70 pixels, .* 70x90"):
        Blender().parse(folder, "train")
    edit(folder, "train", fl_x=None, fl_y=None, camera_angle_x=None, camera_angle_y=None)
    with pytest.raises(DataError, match="neither 'fl_x' nor 'camera_angle_x'"):
        Blender().parse(folder, "train")


def test_without_focal_lengths_pixels_are_square(tmp_path: Path) -> None:
    """Blender's angle_y belongs to its sensor: with it, a pixel would be twice as wide as high."""
    folder = Shot(count=3).write(tmp_path, fl_x=None, fl_y=None)
    cameras = Blender().parse(folder, "train").cameras
    torch.testing.assert_close(cameras.fx, torch.full((3,), 100.0))
    torch.testing.assert_close(cameras.fy, torch.full((3,), 100.0))


def test_given_box_and_distances_stay_in_the_units_of_the_file(tmp_path: Path) -> None:
    folder = Shot(unit=3.0, count=3).write(tmp_path)
    scene = Blender(half_size=3.0, near=5.0, far=20.0, scale_factor=0.5).parse(folder, "train")
    assert scene.transform is None
    torch.testing.assert_close(scene.box, torch.tensor([[-1.5] * 3, [1.5] * 3]))
    assert (scene.near, scene.far, scene.scale) == (2.5, 10.0, 0.5)
    away = Blender(half_size=3.0).parse(folder, "train")
    assert 0 < away.near < 12 - 3 * 3**0.5 < 12 + 3 * 3**0.5 < away.far
    near = Blender(near=5.0).parse(folder, "train")
    assert near.near == pytest.approx(5.0 * near.scale)


@pytest.mark.parametrize("scales", [1, 4])
@pytest.mark.parametrize("distance", [4.0, 4.0311])
def test_nerf_synthetic_stays_as_it_is(distance: float, scales: int, tmp_path: Path) -> None:
    shot = Shot(distance=distance, focal=(139.0, 139.0), size=(100, 100), middle=(50.0, 50.0), count=4)
    only = dict.fromkeys(("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2", "w", "h", "aabb_scale", "camera_angle_y"))
    folder = shot.write(tmp_path, **only)
    for split in ("train", "test"):
        scene = Blender(multiscale=scales).parse(folder, split)  # type: ignore[arg-type]
        assert torch.equal(scene.box, torch.tensor([[-1.5] * 3, [1.5] * 3]))
        assert (scene.near, scene.far, scene.scale, scene.transform) == (2.0, 6.0, 1.0, None)
        written = json.loads((folder / f"transforms_{split}.json").read_text())["frames"]
        assert torch.equal(
            scene.cameras.camera_to_worlds, torch.tensor([f["transform_matrix"] for f in written])[:, :3]
        )
    assert scene.cameras.model == "pinhole"
    angle = json.loads((folder / "transforms_train.json").read_text())["camera_angle_x"]
    assert torch.equal(scene.cameras.fx, torch.full((4,), 0.5 * 100 / math.tan(0.5 * angle)))
    edit(folder, "train", camera_angle_x=1.0)  # shows more than its box
    assert Blender().parse(folder, "train").transform is not None


@pytest.mark.medium
def test_a_trained_scene_is_placed_as_it_was(tmp_path: Path) -> None:
    """The old placement stays, with any new images."""
    shot = Shot(unit=2.0, center=(1.0, 0.0, 0.0))
    folder = shot.write(tmp_path / "data")
    then = Blender().parse(folder, "test")
    assert then.transform is not None
    file = tmp_path / "dataparser_transforms.json"
    file.write_text(json.dumps({"transform": then.transform.tolist(), "scale": then.scale}))
    for index in range(0, 24, 2):
        (folder / "train" / f"{index:04d}.png").unlink()
    now, kept = Blender().parse(folder, "test"), Blender(placement=file).parse(folder, "test")
    assert now.scale != then.scale
    torch.testing.assert_close(kept.cameras.camera_to_worlds, then.cameras.camera_to_worlds)
    assert torch.equal(kept.box, then.box)


def test_an_unreadable_image_says_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shot = Shot(count=8)
    folder = shot.write(tmp_path)
    (folder / "train" / "0002.png").write_bytes(b"")
    scene = Blender().parse(folder, "train")
    assert 1 <= room_around(scene, shot) < 1.6
    assert len(load_dataset(scene, "train")) == 7
    assert "1 of 8 images are unreadable" in capsys.readouterr().err


# -- enclosing boxes ----------------------------------------------------------------------------------------------


def cameras_of(shot: Shot) -> tuple[Cameras, list[torch.Tensor]]:
    poses, count = shot.poses(), shot.count
    values = (*shot.focal, *shot.middle)
    fx, fy, cx, cy = (torch.full((count,), value) for value in values)
    widths, heights = (torch.full((count,), side) for side in shot.size)
    cameras = Cameras(torch.from_numpy(poses[:, :3]).float(), fx, fy, cx, cy, widths, heights)
    return cameras, [torch.from_numpy(shot.opaque(pose)) for pose in poses]


def test_what_images_do_not_bound_or_cannot_show_together_has_no_box() -> None:
    shot = Shot(count=12)
    cameras, opaque = cameras_of(shot)
    assert enclosing_box(cameras, opaque) is not None
    assert enclosing_box(cameras[:1], opaque[:1]) is None
    assert enclosing_box(cameras, [torch.zeros_like(mask) for mask in opaque]) is None
    assert enclosing_box(cameras, [torch.ones_like(mask) for mask in opaque]) is None
    apart = [mask.roll(30 if index % 2 else -30, 1) for index, mask in enumerate(opaque)]
    assert enclosing_box(cameras, apart) is None
