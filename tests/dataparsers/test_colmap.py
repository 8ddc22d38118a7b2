"""The COLMAP format: models are read as COLMAP means them, and damaged ones are refused in one line."""

import os
import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
import torch

from nerfloom.base.errors import DataError
from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.poses import NEAR, estimate_near
from nerfloom.data.dataset import load_dataset
from nerfloom.data.training_images import chosen_images
from nerfloom.dataparsers.colmap import Colmap
from nerfloom.dataparsers.colmap_model import read_model
from nerfloom.dataparsers.llff import Llff
from tests.dataparsers.sparse_models import Capture, make_capture, misses, write_colmap, write_images

pycolmap = pytest.importorskip("pycolmap")
FX, FY, CX, CY = 50.0, 48.0, 31.0, 19.0
RADIAL = "SIMPLE_RADIAL 60 40 50 31 19 0.1"


@pytest.fixture
def capture() -> Capture:
    return make_capture()


@pytest.fixture
def folder(tmp_path: Path, capture: Capture) -> Path:
    write_images(tmp_path / "images", capture.names)
    write_colmap(tmp_path / "sparse" / "0", capture)
    return tmp_path


def as_binary(model: Path) -> None:
    """Replace a text model by a binary one."""
    pycolmap.Reconstruction(str(model)).write_binary(str(model))
    for file in model.glob("*.txt"):
        file.unlink()


@pytest.mark.parametrize("kind", ["text", "binary"])
@pytest.mark.parametrize("place", ["sparse/0", "colmap/sparse/0", "sparse"])
def test_rays_through_keypoints_meet_the_points(tmp_path: Path, capture: Capture, kind: str, place: str) -> None:
    write_images(tmp_path / "images", capture.names)
    model = write_colmap(tmp_path / place, capture)
    if kind == "binary":
        as_binary(model)
    assert Colmap.recognizes(tmp_path)
    scene = Colmap(eval_interval=0).parse(tmp_path, "train")
    assert [path.name for path in scene.image_paths] == capture.names
    assert scene.unbounded
    assert scene.poses == "photographs"
    for image in range(len(capture.names)):
        x, y = capture.seen(image).T
        assert misses(scene, image, FX * x + CX, FY * y + CY, capture.points).max() < 1e-3


@pytest.mark.parametrize(
    ("camera", "model"),
    [("SIMPLE_PINHOLE 60 40 50 31 19", "pinhole"), (RADIAL, "opencv"), ("RADIAL 60 40 50 31 19 0.1 -0.02", "opencv"),
     ("OPENCV 60 40 50 48 31 19 0.1 -0.02 0.003 -0.001", "opencv"), ("SIMPLE_RADIAL 60 40 50 31 19 0", "pinhole"),
     ("OPENCV_FISHEYE 60 40 50 48 31 19 0.1 -0.02 0.003 -0.001", "fisheye")],
)  # fmt: skip
def test_camera_models(tmp_path: Path, capture: Capture, camera: str, model: str) -> None:
    """Against COLMAP's own projection."""
    write_images(tmp_path / "images", capture.names)
    write_colmap(tmp_path / "sparse", capture, camera)
    scene = Colmap(eval_interval=0).parse(tmp_path, "train")
    assert scene.cameras.model == model
    name, width, height, *params = camera.split()
    own = pycolmap.Camera(model=name, width=int(width), height=int(height), params=[float(p) for p in params])
    local = capture.points @ capture.rotations[4].T + capture.translations[4]
    at = np.array([np.ravel(own.img_from_cam(point)) for point in local])
    assert misses(scene, 4, at[:, 0], at[:, 1], capture.points).max() < 2e-3


def test_reduced_images_scale_intrinsics_by_their_own_size(folder: Path, capture: Capture) -> None:
    """61 pixels reduced by 2 are 30, so one folder's name does not say by how much."""
    for file in (folder / "images").iterdir():
        file.unlink()
    write_images(folder / "images_2", capture.names, (29, 20))
    scene = Colmap(eval_interval=0).parse(folder, "train")
    assert scene.image_paths[0].parent.name == "images_2"
    assert scene.cameras.fx[0].item() == pytest.approx(FX * 29 / 60)
    assert scene.cameras.cy[0].item() == pytest.approx(CY * 20 / 40)
    x, y = capture.seen(3).T
    assert misses(scene, 3, (FX * x + CX) * 29 / 60, (FY * y + CY) / 2, capture.points).max() < 1e-3
    assert len(load_dataset(scene, "train")) == 10


def test_every_eighth_by_sorted_name_is_held_out(folder: Path) -> None:
    train, val, test = (Colmap().parse(folder, split) for split in ("train", "val", "test"))
    assert [path.name for path in val.image_paths] == ["p00.png", "p08.png"] == [p.name for p in test.image_paths]
    assert len(train.image_paths) == 8
    assert train.transform is not None
    assert val.transform is not None
    torch.testing.assert_close(train.transform, val.transform)
    assert train.scale == val.scale


@pytest.mark.parametrize(
    ("tracks", "error", "reason"),
    [
        (4, 0.5, ""),
        (2, 0.5, "30 seen by fewer than 3 images"),
        (4, 5.0, "30 with a reprojection error above 2 pixels"),
        (0, 0.0, "30 without a track"),
    ],
)
def test_poor_points_start_gaussians_and_tell_no_distance(
    tmp_path: Path, capture: Capture, capsys: pytest.CaptureFixture[str], tracks: int, error: float, reason: str
) -> None:
    write_images(tmp_path / "images", capture.names)
    seen_by = range(1, 1 + tracks)  # p00 and p08 are held out
    as_binary(write_colmap(tmp_path / "sparse", capture, error=error, seen_by=seen_by))
    scene = Colmap().parse(tmp_path, "train")
    assert scene.points is not None
    assert scene.transform is not None
    expected = scene.scale * (capture.points @ scene.transform[:, :3].T.numpy() + scene.transform[:, 3].numpy())
    found = np.array(sorted(scene.points.tolist()))
    np.testing.assert_allclose(found, np.array(sorted(expected.tolist())), atol=1e-5)
    assert (0 if scene.sightings is None else len(scene.sightings)) == (0 if reason else 120)
    known = 0 if reason else 30
    said = f"sparse points: 30 of 30 are used, {known} at known distances" + (f" (not {reason})" if reason else "")
    assert said in " ".join(capsys.readouterr().err.split())
    assert scene.near == pytest.approx(estimate_near(Colmap().parse(tmp_path, "train").cameras, scene.points), rel=0.2)


def test_poor_points_do_not_move_the_near_distance(tmp_path: Path, capture: Capture) -> None:
    """Points of large error right in front of the cameras, beside good ones."""
    write_images(tmp_path / "images", capture.names)
    model = write_colmap(tmp_path / "sparse", capture)
    near = Colmap(eval_interval=0).parse(tmp_path, "train").near
    wrong = capture.rotations[4].T @ (np.array([0.0, 0.0, 0.1]) - capture.translations[4])
    row = " ".join(map(repr, wrong.tolist()))
    with (model / "points3D.txt").open("a") as file:
        file.writelines(f"{900 + k} {row} 9 9 9 8.0\n" for k in range(30))
    scene = Colmap(eval_interval=0).parse(tmp_path, "train")
    assert scene.near == pytest.approx(near)
    assert scene.points is not None
    assert len(scene.points) == 60


def test_points_that_are_no_numbers_are_counted(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model = folder / "sparse" / "0"
    as_binary(model)
    content = bytearray((model / "points3D.bin").read_bytes())
    content[16:24] = np.array([np.nan]).tobytes()  # after the number of points and the first one's own
    (model / "points3D.bin").write_bytes(content)
    scene = Colmap(eval_interval=0).parse(folder, "train")
    assert scene.points is not None
    assert len(scene.points) == 29
    assert "1 of 30 sparse points are not finite" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize("camera", ["PINHOLE 60 40 50 48 31 19", "OPENCV 60 40 50 48 31 19 0.1 -0.02 0.003 -0.001"])
@pytest.mark.parametrize("kind", ["text", "binary"])
def test_tracks_give_pixels_their_distances(tmp_path: Path, capture: Capture, camera: str, kind: str) -> None:
    """Where COLMAP's own camera projects a point, at the distance from the camera that the capture says."""
    write_images(tmp_path / "images", capture.names, (120, 80))  # twice as large as the model's
    model = write_colmap(tmp_path / "sparse", capture, camera, seen_by=(1, 3, 4, 6))
    if kind == "binary":
        as_binary(model)
    scene = Colmap(eval_interval=0).parse(tmp_path, "train")
    assert scene.sightings is not None
    assert sorted(scene.sightings.images.unique().tolist()) == [1, 3, 4, 6]
    assert len(scene.sightings) == 4 * len(capture.points)
    known = load_dataset(scene, "train").sparse_depth
    assert known is not None
    name, width, height, *params = camera.split()
    own = pycolmap.Camera(model=name, width=int(width), height=int(height), params=[float(p) for p in params])
    checked = 0
    for image in (1, 3, 4, 6):
        local = capture.points @ capture.rotations[image].T + capture.translations[image]
        at = 2 * np.array([np.ravel(own.img_from_cam(point)) for point in local])
        distances = scene.scale * np.linalg.norm(local, axis=-1)
        for (x, y), distance in zip(at, distances, strict=True):
            if not (0 <= x < 120 and 0 <= y < 80):
                continue
            place = (known.pixels == image * 120 * 80 + int(y) * 120 + int(x)).nonzero().flatten().tolist()
            if abs(x - round(x)) > 1e-3 and abs(y - round(y)) > 1e-3:  # not between two pixels
                assert len(place) == 1
                checked += abs(float(known.distances[place[0]]) / distance - 1) < 1e-3
    assert checked > 0.9 * len(known)  # but where two points share a pixel


def test_few_images_start_at_the_points_that_they_see(tmp_path: Path, capture: Capture) -> None:
    """Blocks of a large scene do so. Without tracks, the images of a point are unknown, so all points stay."""
    write_images(tmp_path / "images", capture.names)
    for folder, seen_by, tracks in (("a", (1, 3, 4), 3), ("b", None, 0)):
        write_colmap(tmp_path / folder, capture, seen_by=seen_by, tracks=tracks)
        scene = Colmap(colmap_path=folder, eval_interval=0).parse(tmp_path, "train")
        seeing, others = (chosen_images(scene, None, images).points for images in ((0, 4), (0, 2, 9)))
        assert seeing is not None
        assert torch.equal(seeing, scene.points)  # type: ignore[arg-type]
        assert (others is None) == (folder == "a")


def test_what_held_out_images_know_is_not_learned_from(tmp_path: Path, capture: Capture) -> None:
    """p00 and p08 are held out. If one training image is left, a point's distance is known by them alone."""
    write_images(tmp_path / "images", capture.names)
    for folder, seen_by, count in (("a", (0, 1, 8), None), ("b", (0, 1, 2), 30)):
        write_colmap(tmp_path / folder, capture, seen_by=seen_by)
        train, held_out = (Colmap(colmap_path=folder).parse(tmp_path, split) for split in ("train", "test"))
        assert (None if train.points is None else len(train.points)) == count
        assert held_out.sightings is not None
        assert set(held_out.sightings.images.tolist()) == ({0, 1} if folder == "a" else {0})
        if folder == "a":
            assert train.sightings is None
        elif train.sightings is not None:
            assert sorted(train.sightings.images.unique().tolist()) == [0, 1]
            assert len(train.sightings) == 60
            assert held_out.sightings.deviations.max() < train.sightings.deviations.max()  # three images know more


def test_sightings_follow_the_images_that_exist(folder: Path) -> None:
    """p01 is missing and p00 unreadable: their sightings go, and the others keep their images."""
    (folder / "images" / "p01.png").unlink()
    (folder / "images" / "p03.png").write_bytes(b"no picture")
    scene = Colmap(eval_interval=0).parse(folder, "train")
    assert scene.sightings is not None
    names = [path.name for path in scene.image_paths]
    assert [names[index] for index in scene.sightings.images.unique().tolist()] == ["p00.png", "p02.png"]
    data = load_dataset(scene, "train")
    assert data.sparse_depth is not None
    images = (data.sparse_depth.pixels // (60 * 40)).unique().tolist()
    assert [data.names[index] for index in images] == ["p00.png", "p02.png"]


def test_a_track_that_names_no_image_is_refused_in_one_line(folder: Path) -> None:
    file = folder / "sparse" / "0" / "points3D.txt"
    file.write_text(file.read_text().replace(" 98 ", " 7777 "))
    if version("pycolmap").startswith("3.1"):  # those drop such a track
        assert len(Colmap(eval_interval=0).parse(folder, "train").image_paths)
        return
    with pytest.raises(DataError, match=r"sparse/0 cannot be read: .*7777") as error:
        Colmap(eval_interval=0).parse(folder, "train")
    assert "\n" not in str(error.value)


def test_the_largest_of_several_models_is_taken(
    folder: Path, capture: Capture, capsys: pytest.CaptureFixture[str]
) -> None:
    few = Capture(capture.names[:4], capture.rotations[:4], capture.translations[:4], capture.points)
    for file in (folder / "sparse" / "0").iterdir():
        file.unlink()
    (folder / "sparse" / "0").rmdir()
    write_colmap(folder / "sparse" / "0", few)
    as_binary(write_colmap(folder / "sparse" / "1", capture))
    assert len(Colmap(eval_interval=0).parse(folder, "train").image_paths) == 10
    assert len(Colmap(eval_interval=0).parse(folder, "test").image_paths) == 10
    said = " ".join(capsys.readouterr().err.split())
    assert said.count("2 COLMAP reconstructions") == 1
    assert "using sparse/1 with 10 of the existing images; sparse/0 has 4" in said
    assert len(Colmap(eval_interval=0, colmap_path="sparse/0").parse(folder, "train").image_paths) == 4


@pytest.mark.parametrize("place", ["sparse/1", "sparse/0/models/1", "sparse", "colmap/sparse/0", "."])
def test_the_model_of_the_images_that_are_there_is_taken(tmp_path: Path, capture: Capture, place: str) -> None:
    """sparse/2 has more images, of another folder."""
    write_images(tmp_path / "images", capture.names)
    few = Capture(capture.names[:4], capture.rotations[:4], capture.translations[:4], capture.points)
    other = make_capture(14)
    other.names = [f"other{index:02d}.png" for index in range(14)]
    write_colmap(tmp_path / "sparse" / "0" / "few", few)
    as_binary(write_colmap(tmp_path / "sparse" / "2", other))
    write_colmap(tmp_path / place, capture)
    assert len(Colmap(eval_interval=0).parse(tmp_path, "train").image_paths) == 10


@pytest.mark.parametrize("kind", ["text", "binary"])
def test_names_with_spaces(tmp_path: Path, capture: Capture, kind: str) -> None:
    """pycolmap takes a name in text to end at its first space, so that all of them would be equal."""
    capture.names = [f"shot {9 - index}  (of 10).png" for index in range(10)]
    write_images(tmp_path / "images", capture.names)
    model = write_colmap(tmp_path / "sparse" / "0", capture)
    text = (model / "images.txt").read_text()
    if kind == "binary":  # of its own making, as pycolmap cannot read these names
        (model / "images.txt").write_text(text.replace("shot ", "shot_").replace("  (of 10)", "xx(of_10)"))
        as_binary(model)
        content = (model / "images.bin").read_bytes()
        for name in capture.names:
            content = content.replace(
                name.replace("shot ", "shot_").replace("  (of 10)", "xx(of_10)").encode(), name.encode()
            )
        (model / "images.bin").write_bytes(content)
    scene = Colmap(eval_interval=0).parse(tmp_path, "train")
    assert [path.name for path in scene.image_paths] == sorted(capture.names)
    for image, name in enumerate(sorted(capture.names)):
        x, y = capture.seen(capture.names.index(name)).T
        assert misses(scene, image, FX * x + CX, FY * y + CY, capture.points).max() < 1e-3


def test_images_without_their_second_line_are_refused(folder: Path) -> None:
    """pycolmap would take every other image for keypoints."""
    file = folder / "sparse" / "0" / "images.txt"
    lines = file.read_text().splitlines()
    file.write_text("\n".join([lines[0], *lines[1::2]]) + "\n")
    with pytest.raises(DataError, match=r"images\.txt: .*'p09\.png'"):
        Colmap().parse(folder, "train")
    file.write_text("\n".join(lines[:-1]) + "\n")  # some programs leave out the last line if it is empty
    with pytest.raises(DataError, match=r"images\.txt ends after the first line of image 'p\d\d\.png'; .* add a line"):
        Colmap().parse(folder, "train")


@pytest.mark.parametrize("change", [(".", ","), (" p00.png", ""), ("100 ", "one ")])
def test_a_line_that_is_no_image_is_refused_by_its_number(folder: Path, change: tuple[str, str]) -> None:
    """Programs of other languages write decimal commas, and those of one's own leave out values."""
    file = folder / "sparse" / "0" / "images.txt"
    lines = file.read_text().splitlines(keepends=True)
    place = next(index for index, line in enumerate(lines) if line.endswith("p00.png\n"))
    lines[place] = lines[place].replace(*change)
    file.write_text("".join(lines))
    with pytest.raises(DataError, match=rf"images\.txt: line {place + 1} is damaged: an image has a number, 4 numbers"):
        Colmap().parse(folder, "train")


def test_text_with_a_byte_order_mark_is_refused(folder: Path) -> None:
    """COLMAP would take the mark for a part of the first line."""
    for name in ("cameras", "images", "points3D"):
        file = folder / "sparse" / "0" / f"{name}.txt"
        text = file.read_text()
        file.write_text(text, encoding="utf-8-sig")
        with pytest.raises(DataError, match=rf"{name}\.txt begins with a byte-order mark.*save it without one"):
            Colmap().parse(folder, "train")
        file.write_text(text)


def test_names_of_another_system(tmp_path: Path, capture: Capture, capsys: pytest.CaptureFixture[str]) -> None:
    names = capture.names
    write_images(tmp_path / "input", [name.upper() for name in names])
    write_images(tmp_path / "masks", names[:-1])
    capture.names = [f"C:\\scan\\{name}" for name in names]
    write_colmap(tmp_path, capture)
    assert Colmap.recognizes(tmp_path)
    assert not Colmap.recognizes(write_colmap(tmp_path / "alone", capture))
    scene = Colmap(eval_interval=0).parse(tmp_path, "train")
    assert [path.name for path in scene.image_paths] == [name.upper() for name in names]
    assert scene.mask_paths == (*(tmp_path / "masks" / name for name in names[:-1]), None)
    assert "10 of 10 found in another folder" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize("digits", [2, 3, 6])
def test_rounded_rotations_are_rotations(tmp_path: Path, capture: Capture, digits: int) -> None:
    write_images(tmp_path / "images", capture.names)
    model = write_colmap(tmp_path / "sparse", capture)
    lines = (model / "images.txt").read_text().splitlines()
    for index in range(1, len(lines), 2):
        words = lines[index].split(" ")
        lines[index] = " ".join([words[0], *(f"{float(word):.{digits}f}" for word in words[1:5]), *words[5:]])
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    poses = Colmap(eval_interval=0).parse(tmp_path, "train").cameras.camera_to_worlds[:, :, :3]
    torch.testing.assert_close(poses @ poses.transpose(1, 2), torch.eye(3).expand(10, 3, 3), atol=1e-6, rtol=0)


@pytest.mark.parametrize("numbers", ["0 0 0 0", "2 0 0 0", "0.5 0.5 0.5 0.1"])
def test_what_is_no_rotation_is_refused(folder: Path, numbers: str) -> None:
    """pycolmap takes a quaternion of length 0 for no rotation."""
    file = folder / "sparse" / "0" / "images.txt"
    lines = file.read_text().splitlines()
    words = lines[1].split(" ")
    lines[1] = " ".join([words[0], numbers, *words[5:]])
    file.write_text("\n".join(lines) + "\n")
    with pytest.raises(DataError, match=r"image 'p09\.png' has a quaternion of length"):
        Colmap().parse(folder, "train")


@pytest.mark.parametrize("form", ["{stem}.png", "{name}.png"])
@pytest.mark.parametrize("place", ["masks", "masks_2", "mask", "mask_2"])
def test_masks_are_found_by_the_images_name(
    tmp_path: Path, place: str, form: str, capsys: pytest.CaptureFixture[str]
) -> None:
    capture = make_capture()
    capture.names = [f"cam1/p{index:02d}.jpg" for index in range(10)]
    write_colmap(tmp_path / "sparse", capture)
    images, size = (tmp_path / "images", (60, 40)) if "_" not in place else (tmp_path / "images_2", (30, 20))
    write_images(images, capture.names, size)
    masks = [form.format(stem=name[:-4], name=name) for name in capture.names]
    write_images(tmp_path / place, masks[:-1], size)
    scene = Colmap(eval_interval=0).parse(tmp_path, "train")
    assert scene.mask_paths == (*(tmp_path / place / mask for mask in masks[:-1]), None)
    assert ("used as the folder of masks" in capsys.readouterr().err) == (not place.startswith("masks"))


def test_a_part_of_a_rig_is_named_as_the_whole_is(tmp_path: Path) -> None:
    """Held-out images of one camera keep the folder that tells them from those of the other."""
    capture = make_capture()
    capture.names = [f"{side}/{index}.png" for side in ("left", "right") for index in range(5)]
    write_colmap(tmp_path / "sparse", capture)
    write_images(tmp_path / "images", capture.names)
    scene = Colmap(eval_interval=10).parse(tmp_path, "test")
    assert load_dataset(scene, "test").names == ("left/0.png",)
    assert load_dataset(Colmap(eval_interval=10).parse(tmp_path, "train"), "train").names == tuple(capture.names[1:])


def test_missing_images_are_counted_and_skipped(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "images" / "p03.png").unlink()
    scene = Colmap(eval_interval=0).parse(folder, "train")
    assert len(scene.image_paths) == 9
    assert "1 of 10 images are missing and skipped" in " ".join(capsys.readouterr().err.split())


def test_a_camera_that_is_not_known_is_refused_by_image(tmp_path: Path, capture: Capture) -> None:
    write_images(tmp_path / "images", capture.names)
    write_colmap(tmp_path / "sparse", capture, "FOV 60 40 50 48 31 19 0.9")
    with pytest.raises(DataError, match=r"'p00\.png'.*FOV.*colmap image_undistorter") as error:
        Colmap().parse(tmp_path, "train")
    assert "\n" not in str(error.value)


def test_cameras_of_several_models(folder: Path, capture: Capture) -> None:
    """A pinhole is an opencv camera without distortion; a fisheye is not."""
    cameras = folder / "sparse" / "0" / "cameras.txt"
    text = cameras.read_text()
    cameras.write_text(text.replace("8 PINHOLE 60 40 50 48 31 19", "8 OPENCV 60 40 50 48 31 19 0.1 0 0 0", 1))
    scene = Colmap(eval_interval=0).parse(folder, "train")
    assert scene.cameras.model == "opencv"
    assert scene.cameras.lens is not None
    assert [bool(row.any()) for row in scene.cameras.lens] == [False, True] + [False] * 8
    x, y = capture.seen(5).T
    assert misses(scene, 5, FX * x + CX, FY * y + CY, capture.points).max() < 1e-3
    cameras.write_text(text.replace("8 PINHOLE 60 40 50 48 31 19", "8 OPENCV_FISHEYE 60 40 50 48 31 19 0.1 0 0 0", 1))
    with pytest.raises(DataError, match=r"'p00\.png' .*pinhole.*'p01\.png' .*fisheye"):
        Colmap().parse(folder, "train")


@pytest.mark.parametrize("camera", ["PINHOLE 0 40 50 48 31 19", "PINHOLE 60 40 -50 48 31 19"])
def test_cameras_that_see_nothing(tmp_path: Path, capture: Capture, camera: str) -> None:
    write_images(tmp_path / "images", capture.names)
    write_colmap(tmp_path / "sparse", capture, camera)
    with pytest.raises(DataError, match=r"'p00\.png'.*is invalid"):
        Colmap().parse(tmp_path, "train")


def test_without_pycolmap_one_line_says_how_to_get_it(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(DataError, match="pip install pycolmap"):
        Colmap().parse(folder, "train")


def test_formats_do_not_dispute_a_folder(folder: Path) -> None:
    (folder / "poses_bounds.npy").touch()
    assert Colmap.recognizes(folder)
    assert not Llff.recognizes(folder)
    (folder / "transforms.json").touch()
    assert not Colmap.recognizes(folder)
    assert not Llff.recognizes(folder)
    assert not Colmap.recognizes(folder / "nowhere")


@pytest.mark.parametrize("share", [0.0, 0.3, 0.7, 0.999])
@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_binary_files_cut_short_are_refused_by_name(folder: Path, name: str, share: float) -> None:
    """pycolmap hangs on some of them."""
    model = folder / "sparse" / "0"
    as_binary(model)
    whole = (model / name).read_bytes()
    (model / name).write_bytes(whole[: int(len(whole) * share)])
    with pytest.raises(DataError, match=rf"{name} is truncated") as error:
        Colmap().parse(folder, "train")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("content", [b"\xff" * 64, b"no model at all, just text", bytes(range(256)) * 20])
@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("kind", ["bin", "txt"])
def test_garbage_is_refused(folder: Path, name: str, content: bytes, kind: str) -> None:
    model = folder / "sparse" / "0"
    if kind == "bin":
        as_binary(model)
    (model / f"{name}.{kind}").write_bytes(content)
    with pytest.raises(DataError, match=r"damaged|no image with a pose") as error:
        Colmap().parse(folder, "train")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_a_model_without_one_of_its_files(folder: Path, name: str) -> None:
    model = folder / "sparse" / "0"
    (model / f"{name}.txt").unlink()
    with pytest.raises(DataError, match=r"not a complete COLMAP model|has no COLMAP reconstruction"):
        Colmap().parse(folder, "train")


def test_poses_and_names_that_are_none(folder: Path) -> None:
    images = folder / "sparse" / "0" / "images.txt"
    text = images.read_text()
    first = next(line for line in text.splitlines() if line.endswith("p02.png"))
    number, *_, camera, name = first.split()
    images.write_text(text.replace(first, f"{number} 1 0 0 0 nan 0 0 {camera} {name}"))
    with pytest.raises(DataError, match=r"p02\.png|damaged"):
        read_model(images.parent)
    images.write_text(text.replace("p02.png", "p" * 300))
    with pytest.raises(DataError, match="not the name of a file"):
        read_model(images.parent)


def test_no_folder_and_no_model(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"--data"):
        Colmap().parse(None, "train")
    with pytest.raises(DataError, match=r"no COLMAP reconstruction.*--colmap-path"):
        Colmap().parse(tmp_path, "train")


@pytest.mark.medium
@pytest.mark.data
@pytest.mark.parametrize("scene_name", ["colmap_can", "colmap_cup", "colmap_desk"])
def test_real_points_are_seen_where_their_keypoints_are(real_data: Path, scene_name: str) -> None:
    """Pixels at the size of the images that are read."""
    folder = real_data / scene_name
    scene = Colmap(eval_interval=0).parse(folder, "train")
    model = pycolmap.Reconstruction(os.fspath(folder / "sparse" / "0"))
    by_name = {image.name: image for image in model.images.values()}
    errors = []
    for index, path in enumerate(scene.image_paths):
        image = by_name[path.name]
        camera = model.cameras[image.camera_id]
        width, height = int(scene.cameras.widths[index]), int(scene.cameras.heights[index])
        found = [point for point in image.points2D if point.has_point3D()]
        at = np.stack([point.xy for point in found]) * [width / camera.width, height / camera.height]
        points = np.stack([model.points3D[point.point3D_id].xyz for point in found])
        errors.append(misses(scene, index, at[:, 0], at[:, 1], points))
    assert np.median(np.concatenate(errors)) < 1.5
    assert max(np.median(each) for each in errors) < 3


def test_rays_start_well_before_the_nearest_points() -> None:
    """Cameras in a row look at a wall of points 4 away, and one wrong point is right before a camera."""
    ones = torch.ones(5)
    poses = torch.eye(4)[:3].repeat(5, 1, 1)
    poses[:, 0, 3] = torch.linspace(-1, 1, 5)
    cameras = Cameras(poses, 50 * ones, 50 * ones, 32 * ones, 32 * ones, *[torch.full((5,), 64)] * 2)
    draws = torch.Generator().manual_seed(0)
    wall = torch.cat([2 * torch.rand(999, 2, generator=draws) - 1, torch.full((999, 1), -4.0)], dim=-1)
    points = torch.cat([wall, torch.tensor([[0.0, 0.0, -0.01]])])
    assert estimate_near(cameras, points) == pytest.approx(2.0, rel=0.05)
    assert estimate_near(cameras, points + torch.tensor([0.0, 0.0, 50.0])) == NEAR  # all of them are behind
    assert estimate_near(cameras, None) == estimate_near(cameras, points[:0]) == NEAR
