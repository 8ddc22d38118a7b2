"""The LLFF format: poses_bounds.npy is read as its authors write it, and other files are refused."""

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from nerfloom.base.errors import DataError
from nerfloom.cameras.poses import NEAR
from nerfloom.data.dataset import load_dataset
from nerfloom.dataparsers.colmap import Colmap
from nerfloom.dataparsers.llff import Llff
from tests.dataparsers.sparse_models import Capture, make_capture, misses, write_images

FOCAL = 55.0


def poses_bounds(capture: Capture) -> np.ndarray:
    """(M, 17) for images of 60x40: axes of the camera as columns down, right, back; near 2, far 7."""
    rows = []
    for rotation, translation in zip(capture.rotations, capture.translations, strict=True):
        right, down, ahead = rotation
        position = -rotation.T @ translation
        matrix = np.stack([down, right, -ahead, position, [40, 60, FOCAL]], axis=1)
        rows.append([*matrix.ravel(), 2.0, 7.0])
    return np.array(rows)


def one_side() -> Capture:
    """Cameras within 30 degrees."""
    return make_capture(spread=0.15)


@pytest.fixture
def capture() -> Capture:
    return one_side()


@pytest.fixture
def folder(tmp_path: Path, capture: Capture) -> Path:
    write_images(tmp_path / "images", capture.names)
    np.save(tmp_path / "poses_bounds.npy", poses_bounds(capture))
    return tmp_path


@pytest.mark.parametrize("size", [(60, 40), (30, 20), (29, 20)])
def test_rays_through_pixels_meet_the_points(tmp_path: Path, capture: Capture, size: tuple[int, int]) -> None:
    write_images(tmp_path / ("images" if size == (60, 40) else "images_2"), capture.names, size)
    np.save(tmp_path / "poses_bounds.npy", poses_bounds(capture))
    assert Llff.recognizes(tmp_path)
    scene = Llff(eval_interval=0).parse(tmp_path, "train")
    assert scene.cameras.model == "pinhole"
    for image in range(len(capture.names)):
        x, y = (capture.seen(image) * FOCAL + [30, 20]).T
        assert misses(scene, image, x * size[0] / 60, y * size[1] / 40, capture.points).max() < 1e-3
    assert len(load_dataset(scene, "train")) == 10


def test_bounds_tell_where_a_scene_seen_from_one_side_is(folder: Path) -> None:
    """Everything that a camera sees between near and far is in the box, and rays start a bit before."""
    scene = Llff().parse(folder, "train")
    assert scene.unbounded
    assert scene.poses == "photographs"
    assert scene.near == pytest.approx(0.9 * 2 * scene.scale)
    cameras = scene.cameras
    for image in range(len(cameras)):
        columns, rows = (grid.reshape(-1) for grid in torch.meshgrid(torch.arange(60), torch.arange(40), indexing="xy"))
        rays = cameras.rays(torch.full((2400,), image), columns, rows, 0, 1)
        slant = (rays.directions * -cameras.camera_to_worlds[image, :, 2]).sum(-1)
        for depth in (2, 7):
            points = rays.origins + (depth * scene.scale / slant)[:, None] * rays.directions
            assert bool(((points >= scene.box[0]) & (points <= scene.box[1])).all())
    wider = Llff(scene_scale=2.0).parse(folder, "train").box
    torch.testing.assert_close(wider[1] - wider[0], 2 * (scene.box[1] - scene.box[0]))
    torch.testing.assert_close(Llff().parse(folder, "val").box, scene.box)
    plain = Llff(use_bounds=False).parse(folder, "train")
    assert plain.near == NEAR
    assert plain.box.tolist() == [[-1, -1, -1], [1, 1, 1]]
    assert Llff(near=3.0).parse(folder, "train").near == 3.0


def test_cameras_all_around_keep_the_box_around_them(tmp_path: Path) -> None:
    capture = make_capture()
    write_images(tmp_path / "images", capture.names)
    np.save(tmp_path / "poses_bounds.npy", poses_bounds(capture))
    assert Llff().parse(tmp_path, "train").box.tolist() == [[-1, -1, -1], [1, 1, 1]]


def test_normalised_device_coordinates(folder: Path, capture: Capture) -> None:
    """The pictures' pixels stay, and splits share one box; captures from all around are refused."""
    train, val = (Llff(ndc=True).parse(folder, split) for split in ("train", "val"))
    torch.testing.assert_close(train.box, val.box)
    assert not train.unbounded
    assert train.box[:, 2].tolist() == pytest.approx([-1, 1])
    data = load_dataset(train, "train")
    rays = data.cameras.pixel_rays(data.cameras.image_pixels(3), data.scene.near, data.scene.far)
    assert len(rays) == 60 * 40
    ends = rays.origins + rays.fars[:, None] * rays.directions
    assert bool(((ends >= train.box[0] - 1e-4) & (ends <= train.box[1] + 1e-4)).all())
    assert ends[:, 2].min().item() == pytest.approx(1, abs=1e-4)
    around = make_capture()
    np.save(folder / "poses_bounds.npy", poses_bounds(around))
    with pytest.raises(DataError, match="look the same way"):
        Llff(ndc=True).parse(folder, "train")


def test_masks_and_held_out_images(folder: Path, capture: Capture) -> None:
    write_images(folder / "masks", capture.names)
    val = Llff().parse(folder, "val")
    assert [path.name for path in val.image_paths] == ["p00.png", "p08.png"]
    assert val.mask_paths == (folder / "masks" / "p00.png", folder / "masks" / "p08.png")


def put(row: int, column: int, value: float) -> Any:
    def edit(table: np.ndarray) -> np.ndarray:
        table[row, column] = value
        return table

    return edit


BAD = {
    "fewer rows": (lambda t: t[:-1], "poses of 9 images, but there are 10"),
    "columns": (lambda t: t[:, :15], r"shape \(10, 15\); it must be numbers of shape \(images, 17\)"),
    "flat": (lambda t: t.ravel(), "must be numbers of shape"),
    "text": (lambda t: t.astype(str), "must be numbers of shape"),
    "nan": (put(4, 3, np.nan), "row 4: the pose holds a value that is not finite"),
    "sheared": (put(4, 0, 3.0), "row 4: the pose is not rigid"),
    "no focal length": (put(4, 14, 0.0), "row 4: height .* out of range"),
    "endless width": (put(4, 9, np.inf), "row 4: height .* out of range"),
    "near beyond far": (put(4, 15, 9.0), "row 4: the depth bounds are 9.0 and 7.0"),
    "near behind": (put(4, 15, -1.0), "row 4: the depth bounds are -1.0"),
    "far nan": (put(4, 16, np.nan), "row 4: the depth bounds"),
    "far beyond float32": (put(4, 16, 1e300), r"depth bounds of poses_bounds\.npy give a box .* empty or too large"),
    "other shape": (put(0, 9, 120.0), "p00.png is 60x40 pixels"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_tables_are_refused(folder: Path, capture: Capture, name: str) -> None:
    change, words = BAD[name]
    np.save(folder / "poses_bounds.npy", change(poses_bounds(capture)))
    with pytest.raises(DataError, match=words) as error:
        Llff(eval_interval=0).parse(folder, "train")
    assert "\n" not in str(error.value)


def pickled() -> bytes:
    file = io.BytesIO()
    np.save(file, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    return file.getvalue()


@pytest.mark.parametrize("content", [b"", b"no array", b"\x93NUMPY", b"PK\x03\x04", pickled()])
def test_files_that_are_no_array(folder: Path, content: bytes) -> None:
    (folder / "poses_bounds.npy").write_bytes(content)
    with pytest.raises(DataError, match=r"poses_bounds\.npy") as error:
        Llff().parse(folder, "train")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("keep", [0.5, 0.99])
def test_a_file_cut_short(folder: Path, keep: float) -> None:
    whole = (folder / "poses_bounds.npy").read_bytes()
    (folder / "poses_bounds.npy").write_bytes(whole[: int(len(whole) * keep)])
    with pytest.raises(DataError, match=r"poses_bounds\.npy is not a numpy array"):
        Llff().parse(folder, "train")


def test_no_folder_no_images_and_a_far_that_is_too_near(folder: Path) -> None:
    with pytest.raises(DataError, match=r"--data"):
        Llff().parse(None, "train")
    with pytest.raises(DataError, match=r"--use-bounds False"):
        Llff(far=0.1).parse(folder, "train")
    for file in (folder / "images").iterdir():
        file.unlink()
    with pytest.raises(DataError, match=r"has no images in images, images_2.*--images-path FOLDER"):
        Llff().parse(folder, "train")


def aligned(source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Umeyama (1991): `source` (M, 3) brought onto `target` by a similarity; also its rotation and scale."""
    a, b = source - source.mean(0), target - target.mean(0)
    u, s, vt = np.linalg.svd(b.T @ a)
    signs = np.array([1, 1, np.sign(np.linalg.det(u @ vt))])
    rotation, scale = u * signs @ vt, float((s * signs).sum() / (a**2).sum())
    return scale * a @ rotation.T + target.mean(0), rotation, scale


@pytest.mark.medium
@pytest.mark.data
@pytest.mark.parametrize("name", ["colmap_can", "colmap_cup"])
def test_real_poses_agree_with_colmaps(real_data: Path, name: str) -> None:
    """Two files of one capture, stored sideways: the same photographs must have the same cameras."""
    first, second = (kind(eval_interval=0).parse(real_data / name, "train") for kind in (Colmap, Llff))
    assert [path.name for path in first.image_paths] == [path.name for path in second.image_paths]
    ours, theirs = (scene.cameras.camera_to_worlds.double().numpy() for scene in (first, second))
    moved, rotation, _ = aligned(theirs[:, :, 3], ours[:, :, 3])
    assert np.linalg.norm(moved - ours[:, :, 3], axis=-1).max() < 0.02
    between = rotation @ theirs[:, :, :3] @ ours[:, :, :3].transpose(0, 2, 1)
    angles = np.degrees(np.arccos(np.clip((np.trace(between, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    assert angles.max() < 1
    ratio = (second.cameras.fx / first.cameras.fx).numpy()
    assert abs(ratio - 1).min() < 1e-4  # the file has one photograph's focal length for all
    assert abs(ratio - 1).max() < 0.2


@pytest.mark.data
@pytest.mark.parametrize(("name", "count", "size"), [("fern", 17, (504, 378)), ("statue_of_liberty", 118, (400, 600))])
def test_real_captures(real_data: Path, name: str, count: int, size: tuple[int, int]) -> None:
    scene = Llff().parse(real_data / name, "train")
    assert len(scene.image_paths) == count
    assert (int(scene.cameras.widths[0]), int(scene.cameras.heights[0])) == size
    assert (scene.mask_paths is not None) == (name == "statue_of_liberty")
    assert 0 < scene.near < 5
    assert len(Llff().parse(real_data / name, "val").image_paths) == {"fern": 3, "statue_of_liberty": 17}[name]
