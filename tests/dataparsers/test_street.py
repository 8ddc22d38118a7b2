"""The street: its pictures agree with its depth, its masks with its cars, and it is read as a capture."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import numpy.typing as npt
import pytest
import torch
from scipy.spatial.transform import Rotation

from nerfloom.base.errors import DataError
from nerfloom.data.exposure import exposures_of
from nerfloom.dataparsers.nerfstudio import Nerfstudio
from nerfloom.dataparsers.procedural import Procedural
from nerfloom.dataparsers.procedural.photographs import Changing, lights
from nerfloom.dataparsers.procedural.scene import Hit, Parts, trace_rows
from nerfloom.dataparsers.procedural.street import (
    ANGLE,
    FACE,
    LOT,
    measured,
    photograph,
    street,
    street_poses,
    traffic,
    write_street,
)

SIZE, HOUSES, COUNTS = 32, 2, {"train": 6, "val": 1, "test": 3}
PARTS = street(HOUSES, 0)


def directions(pose: npt.NDArray[np.float64], size: int) -> torch.Tensor:
    """World directions (3, H W) through the centres of pixels."""
    rows, columns = np.mgrid[:size, :size] + 0.5
    focal = size / 2 / math.tan(ANGLE / 2)
    local = np.stack([(columns - size / 2) / focal, (size / 2 - rows) / focal, -np.ones_like(rows)], -1).reshape(-1, 3)
    world = local @ pose[:3, :3].T
    return torch.from_numpy(world / np.linalg.norm(world, axis=-1, keepdims=True)).T.contiguous()


def seen(pose: npt.NDArray[np.float64], size: int = SIZE) -> Hit:
    with torch.no_grad():
        return trace_rows(torch.from_numpy(pose[:3, 3:].copy()), directions(pose, size), 0.0, parts=PARTS)


def test_cameras_are_rigid_on_the_road_and_look_ahead_and_to_both_sides() -> None:
    poses = np.stack(street_poses("train", 30, HOUSES, 0))
    identity = np.broadcast_to(np.eye(3), (30, 3, 3))
    np.testing.assert_allclose(poses[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1), identity, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(poses[:, :3, :3]), 1.0)
    ahead = -poses[:, :3, 2]
    assert (ahead[::3, 0] > 0.9).all()
    assert (ahead[1::3, 1] > 0.8).all()
    assert (ahead[2::3, 1] < -0.8).all()
    assert (np.abs(poses[:, 0, 3]) < HOUSES * LOT / 2).all()
    assert (np.abs(poses[:, 1, 3]) < 0.3).all()
    assert (np.diff(poses[:, 0, 3]) > 0).all()


def places(parts: Parts) -> list[tuple[str, tuple[float, float, float]]]:
    return [(name, part.centre) for name, part in parts.items()]


def test_houses_stand_beside_the_road_and_are_the_same_for_the_same_seed() -> None:
    assert places(street(HOUSES, 0)) == places(PARTS)
    houses = [part for name, part in PARTS.items() if name.startswith(("house left", "house right"))]
    assert len(houses) == 2 * HOUSES
    assert all(abs(part.centre[1]) - 0.8 >= FACE - 1e-9 for part in houses)
    assert all(part.gloss == 0 for part in PARTS.values())
    assert places(street(HOUSES, 1)) != places(PARTS)


def test_pictures_agree_with_depth_by_reprojection() -> None:
    """A point that two cameras see has the same colour in both, as nothing is shiny."""
    one, other = street_poses("test", 12, HOUSES, 0)[1:3]
    other = np.array(other)
    other[:3, :3] = one[:3, :3]  # beside the first, and looking the same way
    hit = seen(one)
    points = torch.from_numpy(one[:3, 3:].copy()) + hit.depth[hit.hit] * directions(one, SIZE)[:, hit.hit]
    towards = points - torch.from_numpy(other[:3, 3:].copy())
    distance = towards.norm(dim=0)
    with torch.no_grad():
        back = trace_rows(torch.from_numpy(other[:3, 3:].copy()), towards / distance, 0.0, parts=PARTS)
    both = (back.depth - distance).abs() < 1e-6
    assert float(both.double().mean()) > 0.5
    off = (back.rgb - hit.rgb[:, hit.hit])[:, both].abs().amax(0)
    assert float((off < 1e-3).double().mean()) > 0.98


def test_a_photograph_shows_what_rays_meet_and_the_sky_elsewhere() -> None:
    pose = street_poses("test", 12, HOUSES, 0)[0]
    shown, hit = photograph(pose, SIZE, PARTS).reshape(-1, 3) / 255, seen(pose)
    assert shown.shape == (SIZE**2, 3)
    off = np.abs(shown - hit.rgb.T.numpy()).max(-1)
    assert np.median(off[hit.hit.numpy()]) < 0.15
    sky = shown[~hit.hit.numpy()]
    assert len(sky) > 20
    assert np.median(sky[:, 2] - sky[:, 0]) > 0  # blue


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The same photographs with and without cars."""
    around = tmp_path_factory.mktemp("street")
    for name, cars in (("busy", 6), ("empty", 0)):
        write_street(
            around / name,
            houses=HOUSES,
            size=SIZE,
            counts=COUNTS,
            cars=cars,
            changing=Changing(exposure=True),
            seed=3,
        )
    return around / "busy", around / "empty"


@pytest.mark.medium
def test_masks_are_black_exactly_where_cars_change_a_colour(folders: tuple[Path, Path]) -> None:
    busy, empty = folders
    masks = []
    for number in range(COUNTS["train"]):
        name = f"train_{number:05d}.png"
        mask = iio.imread(busy / "masks" / name)
        same = (iio.imread(busy / "images" / name) == iio.imread(empty / "images" / name)).all(-1)
        np.testing.assert_array_equal(mask == 255, same)
        masks.append(mask)
    assert set(np.unique(masks)) == {0, 255}
    assert not (empty / "masks").exists()
    for name in ("test_00000.png", "test_00002.png", "val_00000.png"):
        np.testing.assert_array_equal(iio.imread(busy / "images" / name), iio.imread(empty / "images" / name))


@pytest.mark.medium
def test_the_stored_depth_is_where_rays_end(folders: tuple[Path, Path]) -> None:
    frames = json.loads((folders[0] / "transforms.json").read_text())["frames"]
    (frame,) = [frame for frame in frames if "test_00001" in frame["file_path"]]
    parts, pose = street(HOUSES, 3), np.array(frame["transform_matrix"])
    with torch.no_grad():
        hit = trace_rows(torch.from_numpy(pose[:3, 3:].copy()), directions(pose, SIZE), 0.0, parts=parts)
    stored = np.load(folders[0] / "geometry" / "test_00001.npz")
    np.testing.assert_allclose(stored["depth"].ravel(), hit.depth.numpy(), rtol=1e-5)
    np.testing.assert_allclose(stored["normals"].reshape(-1, 3), hit.normals.T.numpy(), atol=1e-6)


def test_cars_do_not_overlap_and_hold_no_camera() -> None:
    pose = street_poses("train", 6, HOUSES, 0)[2]
    cars = list(traffic(pose, 20, np.random.default_rng(0)).values())
    assert len(cars) > 3
    for number, car in enumerate(cars):
        to_camera = torch.from_numpy(pose[:3, 3:]) - torch.tensor(car.centre, dtype=torch.float64)[:, None]
        assert float(car.shape.distance(to_camera)) > 0.05
        lane = [other for other in cars[:number] if other.centre[1] == car.centre[1]]
        assert all(abs(other.centre[0] - car.centre[0]) > 0.84 for other in lane)


@pytest.mark.medium
def test_the_street_is_read_as_a_capture_whose_placement_can_be_given(tmp_path: Path) -> None:
    flags = Procedural(street=2, size=16, num_train=6, cars=2, changing_exposure=True)
    train, test = (flags.parse(None, split) for split in ("train", "test"))
    assert (len(train.image_paths), len(test.image_paths)) == (6, 16)
    assert train.unbounded
    assert train.poses == "exact"
    assert train.appearance_varies
    assert train.mask_paths is not None
    assert None not in train.mask_paths
    assert float(train.cameras.camera_to_worlds[:, :, 3].abs().max()) <= 1 + 1e-6
    content = {"transform": np.eye(3, 4).tolist(), "scale": 0.25}
    (tmp_path / "placement.json").write_text(json.dumps(content))
    placed = dataclasses.replace(flags, placement=tmp_path / "placement.json").parse(None, "train")
    assert placed.scale == pytest.approx(0.25)
    back = (parsed.placement.original_points(parsed.cameras.camera_to_worlds[:, :, 3]) for parsed in (train, placed))
    torch.testing.assert_close(*back, atol=1e-5, rtol=1e-5)


def test_errors_of_poses_are_as_large_as_stated_about_every_axis() -> None:
    """The spread of 400 errors, whatever way a camera looks; a rotation's error is its axis times its angle."""
    random, pose = np.random.default_rng(0), street_poses("train", 5, HOUSES, 0)[1]
    found = np.stack([measured(pose, 0.05, random) for _ in range(400)])
    np.testing.assert_allclose((found[:, :3, 3] - pose[:3, 3]).std(0), 0.05, rtol=0.15)
    turned = found[:, :3, :3] @ pose[:3, :3].T
    np.testing.assert_allclose(turned @ turned.transpose(0, 2, 1), np.broadcast_to(np.eye(3), (400, 3, 3)), atol=1e-10)
    angles = Rotation.from_matrix(turned).as_rotvec()
    np.testing.assert_allclose(angles.std(0), 0.05, rtol=0.15)
    np.testing.assert_allclose(angles.mean(0), 0, atol=0.01)


@pytest.mark.medium
def test_the_file_states_exposures_and_poses_with_errors_and_images_stay(tmp_path: Path) -> None:
    changing, content = Changing(exposure=True), list[Any]()
    for name, error in (("exact", 0.0), ("off", 0.05)):
        write_street(tmp_path / name, houses=HOUSES, size=8, counts=COUNTS, changing=changing, pose_error=error, seed=3)
        content.append(json.loads((tmp_path / name / "transforms.json").read_text())["frames"])
    for exact, off in zip(*content, strict=True):
        same, training = exact["transform_matrix"] == off["transform_matrix"], "train_" in exact["file_path"]
        assert same != training
        image = exact["file_path"]
        assert (tmp_path / "exact" / image).read_bytes() == (tmp_path / "off" / image).read_bytes()
    poses = np.stack([frame["transform_matrix"] for frame in content[0][: COUNTS["train"]]])
    np.testing.assert_allclose(poses, np.stack(street_poses("train", COUNTS["train"], HOUSES, 3)))
    taken = Nerfstudio().parse(tmp_path / "off", "train").taken
    stops = torch.tensor([math.log2(lit.gains[1]) for lit in lights(COUNTS["train"], changing, 3)])
    found = exposures_of(taken)
    assert found is not None
    torch.testing.assert_close(found, stops - stops.mean(), atol=1e-5, rtol=0)
    parsed = Procedural(street=2, size=16, num_train=6, pose_error=0.05).parse(None, "train")
    assert parsed.poses == "device"
    assert parsed.taken is None


@pytest.mark.parametrize(
    "wrong",
    [
        Procedural(street=-1),
        Procedural(cars=2),
        Procedural(street=2, cars=-1),
        Procedural(street=2, moving=True),
        Procedural(street=2, courtyard=True),
        Procedural(street=2, distractors=0.1),
        Procedural(street=2, num_scenes=3),
        Procedural(street=2, pose_error=0.3),
        Procedural(pose_error=0.01),
    ],
)
def test_flags_that_do_not_fit_are_refused(wrong: Procedural) -> None:
    with pytest.raises(DataError, match="--"):
        wrong.parse(None, "train")
