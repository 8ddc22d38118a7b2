"""The dtu format: IDR's and NeuS's folders, written with exact cameras, and one that others have made."""

import io
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from nerfloom.base.errors import DataError
from nerfloom.cameras.poses import nearest_point
from nerfloom.data.dataset import load_dataset
from nerfloom.dataparsers.dtu import Dtu
from nerfloom.training.data_folder import find_data
from tests.dataparsers.captures import (
    CX,
    CY,
    FX,
    FY,
    HEIGHT,
    POINTS,
    WIDTH,
    moved,
    poses,
    to_scene,
    worst_miss,
    write_images,
)
from tests.fuzz.payload import PROOF, Payload

COUNT = 9
MILLIMETRES, SHIFT = 200.0, np.array([-30.0, 15.0, 640.0])
"""Transform from the units of `captures` to the folder's."""
WORLD = MILLIMETRES * POINTS + SHIFT
"""The points in the folder's frame."""
CENTER, RADIUS = MILLIMETRES * POINTS.mean(0) + SHIFT, 1.1 * MILLIMETRES
"""The sphere around the object."""
EXACT = 2e-6
Arrays = dict[str, np.ndarray]


def true_poses(count: int = COUNT) -> np.ndarray:
    return moved(poses(count), MILLIMETRES, SHIFT)


def projections(stretch: float = 1.0, count: int = COUNT, skew: float = 0.0) -> list[np.ndarray]:
    """(4, 4) from the world to pixels of images `stretch` times as large; the first pixel has its centre at 0.5."""
    intrinsic = np.array([[FX, 0, CX], [0, FY, CY], [0, 0, 1]])
    intrinsic[:2] *= stretch
    intrinsic[0, 1] = skew
    found = []
    for pose in true_poses(count):
        matrix = np.eye(4)
        matrix[:3] = intrinsic @ np.linalg.inv(pose @ np.diag([1.0, -1, -1, 1]))[:3]
        found.append(matrix)
    return found


def matrices(stretch: float = 1.0, count: int = COUNT, skew: float = 0.0) -> Arrays:
    """The file's arrays."""
    sphere = np.diag([RADIUS] * 3 + [1.0])
    sphere[:3, 3] = CENTER
    arrays: Arrays = {}
    for index, matrix in enumerate(projections(stretch, count, skew)):
        arrays[f"world_mat_{index}"], arrays[f"scale_mat_{index}"] = matrix, sphere
        arrays[f"world_mat_inv_{index}"], arrays[f"scale_mat_inv_{index}"] = np.linalg.inv(matrix), np.eye(4)
    return arrays


def mask_of(index: int) -> np.ndarray:
    """(HEIGHT, WIDTH) bool, the object: in most of each image, and elsewhere in every one."""
    found = np.zeros((HEIGHT, WIDTH), bool)
    found[3:27, 2 + index % 3 : 35 + index % 3] = True
    return found


def write_dtu(
    folder: Path, arrays: Arrays | None = None, count: int = COUNT, size: tuple[int, int] = (WIDTH, HEIGHT)
) -> Path:
    """A folder as NeuS's authors publish DTU: names of images and masks differ."""
    write_images(folder / "image", [f"{index:06d}.png" for index in range(count)], *size)
    (folder / "mask").mkdir()
    for index in range(count):
        iio.imwrite(folder / "mask" / f"{index:03d}.png", mask_of(index).astype(np.uint8) * 255)
    np.savez(folder / "cameras_sphere.npz", **(matrices(count=count) if arrays is None else arrays))
    return folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_dtu(tmp_path / "scan")


@pytest.mark.parametrize("stretch", [1, 2, 3, 4, 0.5])
@pytest.mark.parametrize("kind", [np.float64, np.float32])
def test_rays_meet_the_points_whatever_size_the_cameras_were_made_for(
    tmp_path: Path, stretch: float, kind: Any
) -> None:
    write_dtu(tmp_path, {name: array.astype(kind) for name, array in matrices(stretch).items()})
    scene = Dtu(eval_interval=0).parse(tmp_path, "train")
    worst = worst_miss_in_world(scene)
    print(f"made for {stretch} times the size, {kind.__name__}: rays miss points by {worst:.1e} of their distance")
    assert worst < (EXACT if kind is np.float64 else 5e-6)


def worst_miss_in_world(scene: Any, true: np.ndarray | None = None) -> float:
    return worst_miss(scene, true_poses() if true is None else true, WORLD)


def test_the_size_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_dtu(tmp_path, matrices(4))
    Dtu().parse(tmp_path, "test")
    assert capsys.readouterr().err == ""
    Dtu().parse(tmp_path, "train")
    said = capsys.readouterr().err
    assert f"for {4 * WIDTH}x{4 * HEIGHT} pixels" in said
    assert f"are {WIDTH}x{HEIGHT}" in said


def test_a_size_that_is_not_likely_is_refused_unless_named(tmp_path: Path) -> None:
    write_dtu(tmp_path, matrices(1.4))
    with pytest.raises(DataError, match=r"cameras_sphere\.npz.*principal point.*40x30 pixels.*--camera-width") as error:
        Dtu().parse(tmp_path, "train")
    assert "\n" not in str(error.value)
    scene = Dtu(eval_interval=0, camera_width=56).parse(tmp_path, "train")
    assert worst_miss_in_world(scene) < EXACT
    across = np.array([[2 / 56, 0, -1, 0], [0, 2 / 42, -1, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    stated = {f"camera_mat_{index}": across for index in range(COUNT)}
    np.savez(tmp_path / "cameras_sphere.npz", **matrices(1.4), **stated)
    assert worst_miss_in_world(Dtu(eval_interval=0).parse(tmp_path, "train")) < EXACT
    with pytest.raises(DataError, match="--camera-width is 0"):
        Dtu(camera_width=0).parse(tmp_path, "train")


@pytest.mark.parametrize("orientation", ["auto", "up", "pca", "none"])
def test_the_sphere_becomes_the_box(folder: Path, orientation: Any) -> None:
    scene = Dtu(orientation_method=orientation, scene_scale=1.25).parse(folder, "train")
    np.testing.assert_allclose(to_scene(scene, CENTER[None]).numpy(), 0, atol=1e-12)
    surface = np.random.default_rng(0).normal(size=(50, 3))
    surface = CENTER + RADIUS * surface / np.linalg.norm(surface, axis=-1, keepdims=True)
    np.testing.assert_allclose(to_scene(scene, surface).norm(dim=-1).numpy(), 1, rtol=1e-12)
    np.testing.assert_allclose(scene.box.numpy(), 1.25 * np.array([[-1, -1, -1], [1, 1, 1]]), rtol=1e-6)
    twice = Dtu(scale_factor=2.0).parse(folder, "train")
    assert twice.scale == pytest.approx(2 / RADIUS)
    assert twice.box.tolist() == [[-2, -2, -2], [2, 2, 2]]


def test_exports_are_in_the_frame_and_unit_of_the_file(folder: Path) -> None:
    scene = Dtu(eval_interval=0).parse(folder, "train")
    back = scene.placement.original_poses(scene.cameras.camera_to_worlds)
    np.testing.assert_allclose(back.numpy(), true_poses()[:, :3], atol=1e-4)


def test_masks_show_the_object_and_rays_run_where_it_is(folder: Path) -> None:
    """Masked-out pixels are transparent although the masks keep most; rays begin before the sphere, and end behind."""
    scene = Dtu().parse(folder, "train")
    data = load_dataset(scene, "train", masks="auto")
    alpha = torch.stack([data.image(index)[..., 3] for index in range(len(data))])
    assert np.array_equal(alpha.numpy(), 255 * np.stack([mask_of(index) for index in range(1, 8)]))
    assert data.scene.has_alpha
    assert not data.scene.unbounded
    away = data.cameras.camera_to_worlds[:, :, 3].norm(dim=-1)
    assert 0.05 < data.scene.near < float(away.min()) - 1
    assert float(away.max()) + 1 < data.scene.far < 3 * float(away.max())
    judged = load_dataset(Dtu().parse(folder, "test"), "test")
    assert judged.kept_of(1) is not None
    assert judged.image(1).shape[-1] == 3
    assert np.array_equal(judged.kept_of(1).numpy(), mask_of(8))  # type: ignore[union-attr]


def test_the_whole_photograph_is_learnt_without_masks(folder: Path) -> None:
    (folder / "mask" / "003.png").write_bytes(b"no mask")
    data = load_dataset(Dtu().parse(folder, "train"), "train", masks="off")
    assert data.kept is None
    assert data.opaque is None
    assert data.scene.unbounded
    assert data.scene.far == 1000


def test_near_and_far_are_within_those_of_the_flags(folder: Path) -> None:
    given = Dtu().parse(folder, "train").object_distances
    assert given is not None
    assert Dtu(near=given[0] + 0.1, far=given[1] - 0.1).parse(folder, "train").object_distances == pytest.approx(
        (given[0] + 0.1, given[1] - 0.1)
    )
    with pytest.raises(DataError, match="--near 900"):
        Dtu(near=900.0).parse(folder, "train")


def test_every_eighth_is_held_out(folder: Path) -> None:
    names = {
        split: [path.name for path in Dtu().parse(folder, split).image_paths] for split in ("train", "val", "test")
    }
    assert names["val"] == names["test"] == ["000000.png", "000008.png"]
    assert names["train"] == [f"{index:06d}.png" for index in range(1, 8)]
    train, test = (Dtu().parse(folder, split) for split in ("train", "test"))
    assert torch.equal(train.placement.transform, test.placement.transform)


def test_other_names_of_folders_and_files(folder: Path) -> None:
    assert find_data(folder) == (folder, "dtu")
    assert find_data(folder / "cameras_sphere.npz") == find_data(folder / "image") == (folder, "dtu")
    for name in ("images", "rgb", "imgs"):
        folder = next(folder.glob("im*" if name != "imgs" else "rgb")).rename(folder / name).parent
        assert find_data(folder) == (folder, "dtu")
        assert len(Dtu().parse(folder, "train").image_paths) == 7
    (folder / "mask").rename(folder / "masks")
    (folder / "cameras_sphere.npz").rename(folder / "cameras.npz")
    masks = Dtu().parse(folder, "train").mask_paths
    assert masks is not None
    assert masks[0] == folder / "masks" / "001.png"
    (folder / "masks").rename(folder / "object")
    assert Dtu().parse(folder, "train").mask_paths is None
    assert Dtu(masks_path="object").parse(folder, "train").mask_paths is not None
    (folder / "transforms.json").write_text("{}")
    assert not Dtu.recognizes(folder)


def test_blendedmvs_as_neus_publishes_it(tmp_path: Path) -> None:
    """768x576 images, a projection and a sphere for each, in units of the reconstruction, and masks of their size."""
    size, stretch = (768, 576), 768 / WIDTH
    write_images(tmp_path / "image", [f"{index:03d}.png" for index in range(3)], *size)
    write_images(tmp_path / "mask", [f"{index:03d}.png" for index in range(3)], *size)
    for index in range(3):
        iio.imwrite(tmp_path / "mask" / f"{index:03d}.png", np.full((576, 768, 3), 255, np.uint8))
    arrays = {name: array for name, array in matrices(stretch, 3).items() if "inv" not in name}
    np.savez(tmp_path / "cameras_sphere.npz", **arrays)
    scene = Dtu(eval_interval=0).parse(tmp_path, "train")
    assert scene.cameras.widths.tolist() == [768] * 3
    assert worst_miss_in_world(scene, true_poses(3)) < EXACT


def test_images_keep_their_cameras_where_some_are_missing(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "image" / "000002.png").unlink()
    (folder / "mask" / "005.png").unlink()
    scene = Dtu(eval_interval=0).parse(folder, "train")
    assert worst_miss_in_world(scene, np.delete(true_poses(), [2, 5], axis=0)) < EXACT
    said = capsys.readouterr().err
    assert "1 of 9 cameras have no image" in said
    assert "1 of 8 images have no mask and are skipped, the first 000005.png" in said
    assert "1 of 8 masks have no image" in said


def test_images_without_camera_are_skipped_and_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arrays = {name: array for name, array in matrices().items() if name[-1] not in "78"}
    scene = Dtu(eval_interval=0).parse(write_dtu(tmp_path, arrays), "train")
    assert worst_miss_in_world(scene, true_poses()[:7]) < EXACT
    assert "2 of 9 images have no camera and are skipped, the first 000007.png" in capsys.readouterr().err


def test_numbers_that_start_elsewhere_go_by_order(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for index in reversed(range(COUNT)):
        (folder / "image" / f"{index:06d}.png").rename(folder / "image" / f"{index + 1:06d}.png")
    scene = Dtu(eval_interval=0).parse(folder, "train")
    assert worst_miss_in_world(scene) < EXACT
    assert scene.mask_paths is not None
    assert [path.name for path in scene.mask_paths if path] == [f"{index:03d}.png" for index in range(COUNT)]
    assert capsys.readouterr().err.count("in the order of their names") == 2


def test_without_a_sphere_cameras_place_the_scene(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_dtu(tmp_path, {name: array for name, array in matrices().items() if "scale" not in name})
    scene = Dtu(eval_interval=0).parse(tmp_path, "train")
    assert "no scale_mat" in capsys.readouterr().err
    assert worst_miss_in_world(scene) < EXACT
    assert scene.object_distances is None
    assert scene.cameras.camera_to_worlds[:, :, 3].abs().max().item() == pytest.approx(1)


def changed(name: str, change: Callable[[np.ndarray], Any]) -> Callable[[Arrays], Any]:
    def apply(arrays: Arrays) -> None:
        arrays[name] = np.array(change(arrays[name].copy()))

    return apply


def filled(where: Any, value: float) -> Callable[[np.ndarray], np.ndarray]:
    def fill(array: np.ndarray) -> np.ndarray:
        array[where] = value
        return array

    return fill


BAD: dict[str, tuple[Callable[[Arrays], Any], str]] = {
    "nan": (changed("world_mat_4", filled((1, 2), np.nan)), "world_mat_4 has entries that are not finite"),
    "infinity": (changed("world_mat_4", filled((0, 3), np.inf)), "world_mat_4 has entries that are not finite"),
    "no determinant": (changed("world_mat_4", filled((2, slice(0, 3)), 0)), "world_mat_4 is singular"),
    "all zero": (changed("world_mat_4", lambda m: 0 * m), "world_mat_4 is singular"),
    "shape": (changed("world_mat_4", lambda m: m[:2]), r"world_mat_4 has shape \(2, 4\)"),
    "one number": (changed("world_mat_4", lambda m: 3.0), r"world_mat_4 has shape \(\)"),
    "text": (changed("world_mat_4", lambda m: np.full((4, 4), "a")), "world_mat_4 holds values of type <U1"),
    "pickled": (changed("world_mat_4", lambda m: np.full((4, 4), Payload(), object)), "world_mat_4 holds pickled"),
    "large": (changed("world_mat_4", lambda m: np.zeros((1000, 1000))), "world_mat_4 is larger than"),
    "skewed": (lambda a: a.update(matrices(skew=3.0)), "has a skew that displaces pixels by"),
    "nan sphere": (changed("scale_mat_1", filled((0, 0), np.nan)), "scale_mat_1 does not map the unit sphere"),
    "flat sphere": (changed("scale_mat_1", filled((2, 2), 0)), "scale_mat_1 does not map the unit sphere"),
    "ellipsoid": (changed("scale_mat_1", filled((2, 2), 999)), "scale_mat_1 does not map the unit sphere"),
    "two spheres": (changed("scale_mat_5", filled((2, 3), 999)), "scale_mat_5 differs from scale_mat_1"),
    "no projections": (lambda a: [a.pop(name) for name in list(a) if name.startswith("world_mat_")], "no projections"),
    "other numbers": (
        lambda a: [a.pop(name) for name in list(a) if name[-1] != "0"] and a.update(world_mat_77=a.pop("world_mat_0")),
        "none for any of the 9 images, such as 000000.png",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_content_is_refused_by_name(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    change, words = BAD[name]
    arrays = matrices()
    if "sphere" in name or name == "ellipsoid":
        for kind in ("world_mat", "scale_mat"):
            arrays.pop(f"{kind}_0")
    change(arrays)
    write_dtu(tmp_path / "scan", arrays)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(DataError, match=words) as error:
        Dtu().parse(tmp_path / "scan", "train")
    assert "\n" not in str(error.value)
    assert "cameras_sphere.npz" in str(error.value)
    assert not (tmp_path / PROOF).exists()


def test_files_that_are_no_archives_are_refused(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    file = folder / "cameras_sphere.npz"
    content = file.read_bytes()
    one = io.BytesIO()
    np.save(one, np.zeros((4, 4)))
    for damaged in (b"", content[:300], content[: len(content) // 2], pickle.dumps(Payload()), one.getvalue()):
        file.write_bytes(damaged)
        with pytest.raises(DataError, match=r"cameras_sphere\.npz is not an archive") as error:
            Dtu().parse(folder, "train")
        assert "\n" not in str(error.value)
    assert not (folder / PROOF).exists()
    flipped = bytearray(content)
    flipped[200:240] = bytes(40)
    file.write_bytes(flipped)
    with pytest.raises(DataError, match=r"cameras_sphere\.npz.* is damaged"):
        Dtu().parse(folder, "train")
    file.unlink()
    with pytest.raises(DataError, match=r"cannot read .*cameras_sphere\.npz"):
        Dtu().parse(folder, "train")


def test_pickled_arrays_that_nobody_asks_for_are_not_read(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    with zipfile.ZipFile(folder / "cameras_sphere.npz", "a") as archive:
        array = io.BytesIO()
        np.save(array, np.array([Payload()], object), allow_pickle=True)
        archive.writestr("notes.npy", array.getvalue())
    assert len(Dtu().parse(folder, "train").image_paths) == 7
    assert not (folder / PROOF).exists()


def test_bad_folders(folder: Path) -> None:
    with pytest.raises(DataError, match="--data"):
        Dtu().parse(None, "train")
    with pytest.raises(DataError, match="--masks-path nowhere"):
        Dtu(masks_path="nowhere").parse(folder, "train")
    with pytest.raises(DataError, match=r"no images in nowhere.*--images-path"):
        Dtu(images_path="nowhere").parse(folder, "train")
    for mask in (folder / "mask").iterdir():
        mask.rename(mask.with_name(f"of_{mask.name}"))
    (folder / "mask" / "of_000.png").rename(folder / "mask" / "of_none.png")
    for index in range(1, COUNT):
        (folder / "mask" / f"of_{index:03d}.png").unlink()
    with pytest.raises(DataError, match=r"no image, like 000000\.png, has one of its 1 masks, like of_none\.png"):
        Dtu().parse(folder, "train")


@pytest.mark.data
@pytest.mark.medium
def test_a_real_scan(real_data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """DTU's scan 24: the middles of the masks meet near the sphere's, which all masks show."""
    path = real_data / "dtu_scan24"
    assert find_data(path) == (path, "dtu")
    scene = Dtu().parse(path, "train")
    assert "for 1600x1200 pixels" in capsys.readouterr().err
    assert (len(scene.image_paths), len(Dtu().parse(path, "test").image_paths)) == (42, 7)
    assert 1 / scene.scale == pytest.approx(231.07, abs=0.01)  # millimetres
    data = load_dataset(scene, "train", masks="auto")
    assert not data.scene.unbounded
    opaque = [data.image(index)[..., 3] > 0 for index in range(len(data))]
    rows, columns = torch.stack([mask.nonzero().double().mean(0) for mask in opaque]).float().unbind(-1)
    rays = data.cameras.rays(torch.arange(len(data)), columns, rows, 0.0, 1.0)
    middle = nearest_point(rays.origins.double(), rays.directions.double())
    print(f"the masks' middles meet at {middle.tolist()}, in radii of the sphere")
    assert float(middle.norm()) < 0.3
    columns, rows, ahead = data.cameras.project(torch.zeros(len(data), 3), torch.arange(len(data)))
    shows = [bool(mask[int(row), int(column)]) for mask, row, column in zip(opaque, rows, columns, strict=True)]
    assert bool(ahead.all())
    assert all(shows)
