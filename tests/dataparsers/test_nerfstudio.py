"""The nerfstudio format: rays go where the file's cameras look, and nonsense is refused in one line."""

import dataclasses
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
from nerfloom.dataparsers.nerfstudio import Nerfstudio
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
    to_scene,
    worst_miss,
    write_capture,
    write_images,
)
from tests.exr_files import write_exr

EXACT = 2e-6
"""Precision of a ray's direction in float32."""
ALL = Nerfstudio(eval_mode="all")


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    return write_capture(tmp_path / "scene")


@pytest.mark.parametrize("orientation", ["up", "pca", "none"])
@pytest.mark.parametrize("center", ["poses", "focus", "none"])
@pytest.mark.parametrize("auto_scale", [True, False])
def test_rays_meet_the_points_that_the_files_cameras_see(
    capture: Path, orientation: Any, center: Any, auto_scale: bool
) -> None:
    flags = Nerfstudio(
        eval_mode="all",
        orientation_method=orientation,
        center_method=center,
        auto_scale_poses=auto_scale,
        scale_factor=1.5,
    )
    scene = flags.parse(capture, "train")
    worst = worst_miss(scene, poses())
    print(f"rays miss known points by {worst:.1e} of their distance")
    assert worst < EXACT
    largest = scene.cameras.camera_to_worlds[:, :, 3].abs().max().item()
    assert largest == pytest.approx(1.5) if auto_scale else largest > 1.5
    assert scene.unbounded
    assert scene.poses == "photographs"
    assert (scene.near, scene.far) == (0.05, 1000.0)
    assert scene.box.tolist() == [[-1] * 3, [1] * 3]


def test_places_far_from_the_origin_keep_their_precision(capture: Path) -> None:
    """Positions of a survey: metres, millions of them from the origin."""
    away = np.array([5e5, 4e6, 100.0])

    def move(content: dict[str, Any]) -> None:
        for frame in content["frames"]:
            for axis in range(3):
                frame["transform_matrix"][axis][3] += away[axis]

    near = ALL.parse(capture, "train").cameras.camera_to_worlds
    edit(capture, move)
    far = ALL.parse(capture, "train").cameras.camera_to_worlds
    apart = (near[:, :, 3] - near[:1, :, 3]) - (far[:, :, 3] - far[:1, :, 3])
    assert apart.abs().max() < 1e-5


def test_instant_ngp_gives_angles(capture: Path) -> None:
    def angles(content: dict[str, Any]) -> None:
        for key in ("camera_model", "fl_x", "fl_y", "cx", "cy", "w", "h"):
            del content[key]
        content.update(camera_angle_x=0.8, camera_angle_y=0.6)

    edit(capture, angles)
    cameras = ALL.parse(capture, "train").cameras
    assert cameras.fx[0].item() == pytest.approx(WIDTH / 2 / math.tan(0.4))
    assert cameras.fy[0].item() == pytest.approx(HEIGHT / 2 / math.tan(0.3))
    assert (cameras.cx[0].item(), cameras.cy[0].item()) == (WIDTH / 2, HEIGHT / 2)
    edit(capture, lambda c: c.pop("camera_angle_y"))
    cameras = ALL.parse(capture, "train").cameras
    assert torch.equal(cameras.fx, cameras.fy)


def test_a_frames_own_intrinsics_go_before_those_of_all(capture: Path) -> None:
    edit(capture, lambda c: c["frames"][2].update(fl_x=77.0, cy=3.0, k1=0.1))
    edit(capture, lambda c: c["frames"][3].update(camera_angle_x=1.0))
    cameras = ALL.parse(capture, "train").cameras
    assert cameras.fx[:4].tolist() == pytest.approx([FX, FX, 77, WIDTH / 2 / math.tan(0.5)])
    assert cameras.cy[:4].tolist() == [CY, CY, 3, CY]
    assert cameras.lens is not None
    assert cameras.lens[:4, 0].tolist() == pytest.approx([0, 0, 0.1, 0])


COEFFICIENTS = {"k1": 0.1, "k2": 0.2, "k3": 0.3, "k4": 0.4, "k5": 0.5, "k6": 0.6, "p1": 0.01, "p2": 0.02}
LENSED = {
    None: ("opencv", [0.1, 0.2, 0.01, 0.02, 0.3, 0, 0, 0, 0.4]),
    "OPENCV": ("opencv", [0.1, 0.2, 0.01, 0.02, 0.3, 0, 0, 0, 0.4]),
    "SIMPLE_RADIAL": ("opencv", [0.1, 0.2, 0.01, 0.02, 0.3, 0, 0, 0, 0.4]),
    "FULL_OPENCV": ("opencv", [0.1, 0.2, 0.01, 0.02, 0.3, 0.4, 0.5, 0.6, 0]),
    "OPENCV_FISHEYE": ("fisheye", [0.1, 0.2, 0.3, 0.4]),
}


@pytest.mark.parametrize("name", LENSED)
def test_lenses(capture: Path, name: str | None) -> None:
    edit(capture, lambda c: c.update(camera_model=name, **COEFFICIENTS))
    cameras = ALL.parse(capture, "train").cameras
    model, expected = LENSED[name]
    assert cameras.model == model
    assert cameras.lens is not None
    assert cameras.lens.shape == (9, len(expected))
    assert cameras.lens[5].tolist() == pytest.approx(expected)


K1, K2, K3, K4, P1, P2 = 0.05, -0.02, 0.01, 0.004, 0.003, -0.002
CURVED = {"k1": K1, "k2": K2, "k3": K3, "k4": K4, "p1": P1, "p2": P2}


def seen_through(model: str, right: float, down: float, ahead: float) -> tuple[float, float]:
    """Where on the image, in focal lengths from the principal point, a lens puts a point in front of the camera."""
    if model == "OPENCV":
        x, y = right / ahead, down / ahead
        square = x * x + y * y
        radial = 1 + K1 * square + K2 * square**2 + K3 * square**3 + K4 * square**4
        return (
            x * radial + 2 * P1 * x * y + P2 * (square + 2 * x * x),
            y * radial + P1 * (square + 2 * y * y) + 2 * P2 * x * y,
        )
    if model == "OPENCV_FISHEYE":
        off = math.hypot(right, down)
        angle = math.atan2(off, ahead)
        bent = angle * (1 + K1 * angle**2 + K2 * angle**4 + K3 * angle**6 + K4 * angle**8)
        return bent * right / off, bent * down / off
    if model == "EQUIRECTANGULAR":  # nerfstudio's focal length is half the width of a whole panorama
        longitude = math.atan2(right, ahead)
        return longitude / math.pi, math.asin(down / math.hypot(right, down, ahead)) / math.pi
    return right, down


@pytest.mark.parametrize("model", ["OPENCV", "OPENCV_FISHEYE", "EQUIRECTANGULAR", "ORTHOPHOTO"])
def test_rays_through_lenses_meet_the_points_that_are_seen(capture: Path, model: str) -> None:
    pytest.importorskip("nerfloom.geometry.lenses")
    edit(capture, lambda c: c.update(camera_model=model, **CURVED))
    scene = ALL.parse(capture, "train")
    placed, worst = to_scene(scene, POINTS), 0.0
    for camera, pose in enumerate(poses()):
        for point, target in zip(POINTS, placed, strict=True):
            right, up, back = pose[:3, :3].T @ (point - pose[:3, 3])
            x, y = seen_through(model, right, -up, -back)
            worst = max(worst, miss(scene.cameras, camera, CX + FX * x, CY + FY * y, target))
    print(f"{model}: rays miss known points by {worst:.1e} of their distance")
    assert worst < EXACT


def test_a_lens_without_distortion_is_a_pinhole(capture: Path) -> None:
    edit(capture, lambda c: c.update(camera_model="OPENCV", k1=0.0))
    cameras = ALL.parse(capture, "train").cameras
    assert (cameras.model, cameras.lens) == ("pinhole", None)


def test_panoramas_and_orthographic_pictures(capture: Path) -> None:
    """A whole panorama's width is 2 pi radians. Orthographic focal lengths are per unit, and units are scaled."""
    edit(capture, lambda c: c.update(camera_model="EQUIRECTANGULAR"))
    edit(capture, lambda c: [c.pop(key) for key in ("fl_x", "fl_y", "cx", "cy")])
    cameras = ALL.parse(capture, "train").cameras
    assert cameras.model == "equirectangular"
    assert cameras.fx[0].item() == pytest.approx(WIDTH / (2 * math.pi))
    assert cameras.fy[0].item() == pytest.approx(HEIGHT / math.pi)
    edit(capture, lambda c: c.update(camera_model="ORTHOPHOTO", fl_x=10.0))
    scene = ALL.parse(capture, "train")
    assert scene.cameras.model == "orthographic"
    assert scene.cameras.fx[0].item() == pytest.approx(10 / scene.scale)


def test_the_way_back_leads_to_the_frame_that_the_file_was_made_from(capture: Path) -> None:
    """The file's frame is 3 * (A x), A being half a turn about x with a shift; points seen are known in x."""
    applied = [[1, 0, 0, 0.5], [0, -1, 0, 0.25], [0, 0, -1, 2.0]]
    edit(capture, lambda c: c.update(applied_transform=applied, applied_scale=3.0))
    scene = ALL.parse(capture, "train")
    matrix = np.array(applied)
    original = (POINTS / 3 - matrix[:, 3]) @ matrix[:, :3]
    plain = write_capture(capture.parent / "plain")
    torch.testing.assert_close(
        to_scene(scene, original), to_scene(ALL.parse(plain, "train"), POINTS), rtol=0, atol=1e-6
    )


def test_sparse_points_lie_where_cameras_see_them(capture: Path) -> None:
    lines = "\n".join(" ".join(map(str, point)) for point in POINTS)
    head = f"ply\nformat ascii 1.0\nelement vertex {len(POINTS)}\n" + "".join(f"property float {a}\n" for a in "xyz")
    (capture / "points.ply").write_text(f"{head}end_header\n{lines}\n")
    edit(capture, lambda c: c.update(ply_file_path="points.ply", applied_scale=2.0))
    scene = ALL.parse(capture, "train")
    edit(capture, lambda c: c.pop("applied_scale"))
    assert scene.points is not None
    expected = to_scene(ALL.parse(capture, "train"), POINTS).float()
    torch.testing.assert_close(scene.points, expected, rtol=0, atol=1e-6)


def test_sparse_points_beyond_float32_are_left_out(capture: Path) -> None:
    head = "ply\nformat ascii 1.0\nelement vertex 2\n" + "".join(f"property double {axis}\n" for axis in "xyz")
    (capture / "points.ply").write_text(f"{head}end_header\n1e300 0 0\n0.5 0 0\n")
    edit(capture, lambda c: c.update(ply_file_path="points.ply"))
    points = ALL.parse(capture, "train").points
    assert points is not None
    assert len(points) == 1


def test_missing_sparse_points_are_done_without(capture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    edit(capture, lambda c: c.update(ply_file_path="points.ply"))
    assert ALL.parse(capture, "train").points is None
    assert "points.ply does not exist" in capsys.readouterr().err


def test_instant_ngps_cube(capture: Path) -> None:
    """aabb_scale 4 at scale 0.5: edges of 8 units. Offset (0.5, 0.5, 1) puts the cube's centre at z = -1."""
    edit(capture, lambda c: c.update(aabb_scale=4, scale=0.5, offset=[0.5, 0.5, 1.0]))
    scene = Nerfstudio(orientation_method="none").parse(capture, "train")
    corners = to_scene(scene, np.array([[-4.0, -4, -5], [4, 4, 3]]))
    torch.testing.assert_close(scene.box, corners.float())
    turned = Nerfstudio(orientation_method="pca").parse(capture, "train")
    torch.testing.assert_close(turned.box.mean(0), to_scene(turned, np.array([[0.0, 0, -1]]))[0].float())
    torch.testing.assert_close(turned.box[1] - turned.box[0], torch.full((3,), 8 * turned.scale))


@pytest.mark.parametrize(
    ("flags", "train", "held"),
    [
        (Nerfstudio(), [1, 2, 3, 4, 5, 6, 7], [0, 8]),
        (Nerfstudio(eval_interval=4), [1, 2, 3, 5, 6, 7], [0, 4, 8]),
        (Nerfstudio(eval_interval=0), list(range(9)), list(range(9))),
        (Nerfstudio(eval_mode="fraction", train_split_fraction=0.5), [0, 2, 4, 6, 8], [1, 3, 5, 7]),
        (ALL, list(range(9)), list(range(9))),
    ],
)
def test_splits(capture: Path, flags: Nerfstudio, train: list[int], held: list[int]) -> None:
    edit(capture, lambda c: c["frames"].reverse())  # by sorted name, in any order of the file

    def names(split: Split) -> list[int]:
        return [int(path.stem) for path in flags.parse(capture, split).image_paths]

    assert names("train") == train
    assert names("val") == held
    assert names("test") == held


def test_a_files_own_lists(capture: Path) -> None:
    edit(capture, lambda c: c.update(test_filenames=["./images/003.png", "images/001.png"]))
    edit(capture, lambda c: c.update(train_filenames=["images/000.png"]))
    for split, expected in (("train", ["000"]), ("test", ["001", "003"]), ("val", ["001", "003"])):
        assert [path.stem for path in Nerfstudio().parse(capture, split).image_paths] == expected  # type: ignore[arg-type]
    edit(capture, lambda c: c.pop("train_filenames"))
    assert len(Nerfstudio().parse(capture, "train").image_paths) == 7
    edit(capture, lambda c: c.update(test_filenames=["images/no.png"]))
    with pytest.raises(DataError, match=r"'test_filenames' lists 'images/no\.png'"):
        Nerfstudio().parse(capture, "train")


def test_split_by_name(capture: Path) -> None:
    for index in (2, 5):
        (capture / "images" / f"{index:03d}.png").rename(capture / "images" / f"eval_{index}.png")
        edit(capture, lambda c, i=index: c["frames"][i].update(file_path=f"images/eval_{i}.png"))
    flags = Nerfstudio(eval_mode="filename")
    assert [path.stem for path in flags.parse(capture, "test").image_paths] == ["eval_2", "eval_5"]
    assert len(flags.parse(capture, "train").image_paths) == 7


def test_masks_depths_and_times(capture: Path) -> None:
    write_images(capture / "masks", ["000.png", "001.png"])
    edit(capture, lambda c: c["frames"][0].update(mask_path="masks/000.png", depth_file_path="depths/000.png"))
    edit(capture, lambda c: c["frames"][1].update(mask_path="masks/001.png"))
    edit(capture, lambda c: [frame.update(time=i / 8) for i, frame in enumerate(c["frames"])])
    scene = Nerfstudio(depth_unit_scale_factor=0.01).parse(capture, "val")
    assert scene.mask_paths == (capture / "masks" / "000.png", None)
    assert scene.depth_paths == (capture / "depths" / "000.png", None)
    assert scene.depth_unit == 0.01
    assert scene.times is not None
    assert scene.times.tolist() == [0, 1]
    (capture / "masks" / "001.png").unlink()
    assert Nerfstudio().parse(capture, "val").mask_paths is not None
    with pytest.raises(
        DataError,
        match=r"masks/001\.png does not exist \(missing in all: 1\).*000\.png",
    ):
        Nerfstudio().parse(capture, "train")


def test_names_of_windows(capture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Masks and lists are written likewise."""
    write_images(capture / "masks", ["004.png"])

    def change(content: dict[str, Any]) -> None:
        for frame in content["frames"]:
            frame["file_path"] = "C:\\scan\\" + frame["file_path"].replace("/", "\\").upper()
        content["frames"][4]["mask_path"] = "masks\\004.PNG"
        content["test_filenames"] = ["c:/scan/images/003.png"]

    edit(capture, change)
    scene = Nerfstudio().parse(capture, "train")
    assert worst_miss(scene, np.delete(poses(), 3, axis=0)) < EXACT
    assert scene.mask_paths == (*[None] * 3, capture / "masks" / "004.png", *[None] * 4)
    assert [path.name for path in Nerfstudio().parse(capture, "test").image_paths] == ["003.png"]
    said = capsys.readouterr().err
    assert said.count("9 of 9 found in another folder") == 1  # of training alone
    assert "files of 'mask_path': 1 of 1 found in another case" in said


@pytest.mark.parametrize("digits", [2, 3, 5])
def test_rounded_matrices_are_rotations(capture: Path, digits: int) -> None:
    def change(content: dict[str, Any]) -> None:
        for frame in content["frames"]:
            frame["transform_matrix"] = np.round(frame["transform_matrix"], digits).tolist()

    edit(capture, change)
    rotations = ALL.parse(capture, "train").cameras.camera_to_worlds[:, :, :3].double()
    unit = torch.eye(3, dtype=torch.float64).expand(9, 3, 3)
    torch.testing.assert_close(rotations @ rotations.transpose(1, 2), unit, atol=1e-6, rtol=0)


@pytest.mark.parametrize("stated", ["none", "up", "pca", "vertical", 3])
def test_the_up_direction_that_a_file_states(capture: Path, stated: Any) -> None:
    """Entries of nerfstudio are followed where the flag leaves it to the data, and unknown ones are not."""
    known = stated if stated in ("none", "up", "pca") else "auto"
    expected = Nerfstudio(orientation_method=known).parse(capture, "train").transform
    asked = Nerfstudio(orientation_method="pca").parse(capture, "train").transform
    assert expected is not None
    assert asked is not None
    edit(capture, lambda content: content.update(orientation_override=stated))
    left_to_the_file = Nerfstudio().parse(capture, "train")
    of_the_flag = Nerfstudio(orientation_method="pca").parse(capture, "train")
    assert torch.equal(left_to_the_file.transform, expected)  # type: ignore[arg-type]
    assert torch.equal(of_the_flag.transform, asked)  # type: ignore[arg-type]
    assert load_dataset(left_to_the_file, "train").scene.z_is_up
    assert not of_the_flag.z_is_up


@pytest.mark.parametrize("ending", ["exr", "NPY"])
def test_the_unit_of_depth_in_fractions_is_said(capture: Path, capsys: pytest.CaptureFixture[str], ending: str) -> None:
    (capture / "depth").mkdir()
    depth = np.full((HEIGHT, WIDTH), 2.5, np.float32)
    write_exr(capture / "depth" / "000.exr", {"Z": depth})
    np.save(capture / "depth" / "000.npy", depth[..., None])
    (capture / "depth" / "000.npy").rename(capture / "depth" / "000.NPY")
    edit(capture, lambda c: c["frames"][0].update(depth_file_path=f"depth/000.{ending}"))
    for factor, said in ((0.001, True), (1.0, False)):
        flags = Nerfstudio(eval_interval=0, depth_unit_scale_factor=factor)
        scene = flags.parse(capture, "train")
        assert ("depths are read as millimetres" in capsys.readouterr().err) == said
        depths = load_dataset(scene, "train").depths
        assert depths is not None
        assert float(depths.max()) == pytest.approx(2.5 * factor * scene.scale, rel=1e-3)


def test_an_image_on_its_side_is_refused_with_what_turns_it(capture: Path) -> None:
    """Programs that obey EXIF have cameras for the upright image."""
    name = capture / "images" / "003.png"
    for width, height, words in (
        (HEIGHT, WIDTH, "30x40 pixels, but its camera is for 40x30: it is stored on its side; turn such images"),
        (2 * HEIGHT, 2 * WIDTH, "it is stored on its side"),
        (WIDTH, WIDTH, "it was cropped or rotated"),
    ):
        iio.imwrite(name, np.zeros((height, width, 3), np.uint8))
        with pytest.raises(DataError, match=words):
            ALL.parse(capture, "train")


def test_missing_images_are_skipped_and_reported_once(capture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for index in (3, 4):
        (capture / "images" / f"{index:03d}.png").unlink()
    scene = ALL.parse(capture, "train")
    assert len(scene.image_paths) == 7
    assert worst_miss(scene, np.delete(poses(), [3, 4], axis=0)) < EXACT
    said = capsys.readouterr().err
    assert said.count("2 of 9 images are missing and skipped") == 1
    assert "003.png" in said


@pytest.mark.parametrize("written", ["./images/004.png", "images/004", "absolute", "../scene/images/004.png"])
def test_ways_to_name_an_image(capture: Path, written: str) -> None:
    name = str(capture / "images" / "004.png") if written == "absolute" else written
    edit(capture, lambda c: c["frames"][4].update(file_path=name))
    scene = ALL.parse(capture, "train")
    assert sum(path.resolve() == (capture / "images" / "004.png").resolve() for path in scene.image_paths) == 1
    assert len(load_dataset(scene, "train")) == 9


def test_a_file_may_be_named_instead_of_its_folder(capture: Path) -> None:
    (capture / "transforms.json").rename(capture / "other.json")
    assert len(ALL.parse(capture / "other.json", "train").image_paths) == 9


def frame(**changes: Any) -> Any:
    return lambda c: c["frames"][4].update(changes)


def put(**changes: Any) -> Any:
    return lambda c: c.update(changes)


def cell(row: int, column: int, value: Any) -> Any:
    return lambda c: c["frames"][4]["transform_matrix"][row].__setitem__(column, value)


BAD = {
    "no frames": (put(frames=[]), "lists no frames"),
    "frames is an object": (put(frames={"a": 1}), "lists no frames; 'frames' must be a list"),
    "frame is a number": (lambda c: c["frames"].__setitem__(4, 7), "frame 4 is 7; it must be an object"),
    "no file": (lambda c: c["frames"][4].pop("file_path"), "frame 4: 'file_path' is missing"),
    "file name with a zero": (frame(file_path="a\0b"), "frame 4: 'file_path' is not the name of a file"),
    "endless file name": (frame(file_path="a" * 10_000), "frame 4: 'file_path' is not the name of a file"),
    "letters of two bytes": (frame(file_path="é" * 200), "frame 4: 'file_path' is not the name of a file"),
    "endless way to a file": (frame(file_path="a/" * 3000 + "b"), "frame 4: 'file_path' is not the name of a file"),
    "half a letter": (frame(file_path="\ud800"), "frame 4: 'file_path' is not the name of a file"),
    "name of two lines": (frame(mask_path="a\nb"), r"a\\nb\.png does not exist"),
    "no pose": (lambda c: c["frames"][4].pop("transform_matrix"), "frame 4: 'transform_matrix' is not a 4x4 matrix"),
    "nan pose": (cell(0, 3, math.nan), "frame 4: the pose holds a value that is not finite"),
    "text pose": (cell(0, 3, "x"), "frame 4: 'transform_matrix' is not a 4x4 matrix"),
    "mirrored pose": (
        lambda c: [row.__setitem__(0, -row[0]) for row in c["frames"][4]["transform_matrix"][:3]],
        "frame 4: the pose is not rigid",
    ),
    "zero focal length": (put(fl_x=0.0), "frame 0: 'fl_x' is 0.0; it must be a number above zero"),
    "negative focal length": (frame(fl_y=-5), "frame 4: 'fl_y' is -5; it must be a number above zero"),
    "nan focal length": (put(fl_x=math.nan), "frame 0: 'fl_x' is nan"),
    "huge focal length": (put(fl_x=10**400), "frame 0: 'fl_x' is a huge integer"),
    "text focal length": (put(fl_x="long"), "frame 0: 'fl_x' is 'long'"),
    "no focal length": (
        lambda c: [c.pop("fl_x"), c.pop("fl_y")],
        "frame 0: there is no focal length, neither 'fl_x' nor 'camera_ang",
    ),
    "flat angle": (lambda c: [c.pop("fl_x"), c.update(camera_angle_x=4.0)], "'camera_angle_x' is 4.0"),
    "nan centre": (put(cx=math.nan), "frame 0: 'cx' is nan"),
    "text coefficient": (put(k1="a"), "frame 0: 'k1' is 'a'"),
    "zero width": (put(w=0), "frame 0: 'w' is 0; it must be a number above zero"),
    "endless width": (put(w=1e300), "frame 0: 'w' is 1e.300; it must be from 1"),
    "no pixel wide": (put(w=0.3), "frame 0: 'w' is 0.3; it must be from 1"),
    "focal length beyond float32": (put(fl_x=1e200), "has fx, fy, cx, cy = 1e.200, 52, 21, 14 pixels: out of range"),
    "focal length that float32 rounds to zero": (put(fl_y=1e-60), "pixels: out of range; correct them"),
    "centre beyond float32": (frame(cx=-1e200), r"004\.png: its camera has .* pixels: out of range"),
    "other shape": (put(w=30, h=40), r"000\.png is 40x30 pixels, but its camera is for 30x40"),
    "unknown camera": (put(camera_model="OPENCVV"), "unknown camera_model 'OPENCVV'; known: PERSPECTIVE, PINHOLE"),
    "camera is a list": (put(camera_model=[1]), "unknown camera_model"),
    "mixed cameras": (frame(camera_model="OPENCV_FISHEYE"), "mixes the camera models OPENCV_FISHEYE and PINHOLE"),
    "mask is a number": (frame(mask_path=3), "frame 4: 'mask_path' is missing"),
    "missing mask": (frame(mask_path="masks/no.png"), r"masks/no\.png does not exist"),
    "one time": (frame(time=0.5), "frame 0: 'time' is None"),
    "late time": (lambda c: [f.update(time=2) for f in c["frames"]], "frame 0: 'time' is 2"),
    "list is a text": (put(train_filenames="a"), "'train_filenames' is 'a'; it must be a list of names"),
    "list of numbers": (put(train_filenames=[3]), "'train_filenames' is missing"),
    "applied transform is none": (put(applied_transform=3), "'applied_transform': the pose has shape"),
    "applied transform mirrors": (
        put(applied_transform=[[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]),
        "'applied_transform': the pose is not rigid",
    ),
    "applied scale is zero": (put(applied_scale=0), "'applied_scale' is 0; it must be a number above zero"),
    "applied scale is next to zero": (
        put(applied_scale=5e-324),
        "'applied_scale' give a transform out of range; correct",
    ),
    "cube is nothing": (put(aabb_scale=-1), "'aabb_scale' is -1"),
    "cube is a point": (put(aabb_scale=1e-300), "give a box that is empty or too large; change them"),
    "cube is endless": (put(aabb_scale=1e300), "give a box that is empty or too large"),
    "cube is nowhere": (put(aabb_scale=1, offset=[0, 1e300, 0]), "give a box that is empty or too large"),
    "offset is a number": (put(aabb_scale=1, offset=0.5), "'offset' is 0.5; it must be a list of 3 numbers"),
    "sparse points are a number": (put(ply_file_path=5), "'ply_file_path' is missing"),
    "sparse points are no points": (put(ply_file_path="transforms.json"), "transforms.json is not a PLY file"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_content_is_refused_by_name(capture: Path, name: str) -> None:
    change, words = BAD[name]
    edit(capture, change)
    with pytest.raises(DataError, match=words) as error:
        Nerfstudio().parse(capture, "train")
    assert "\n" not in str(error.value)
    assert str(capture) in str(error.value)
    assert len(str(error.value)) < 300 + len(str(capture)) + 2 * (name == "endless file name")


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-be", "utf-32"])
def test_encodings_of_windows(capture: Path, encoding: str) -> None:
    # Notepad marks UTF-8, and a redirection in PowerShell writes UTF-16.
    file = capture / "transforms.json"
    file.write_text(file.read_text(), encoding=encoding)
    assert worst_miss(ALL.parse(capture, "train"), poses()) < EXACT


@pytest.mark.parametrize("text", ["", "{", "[1, 2]", '"text"', "\x00\xff", "[" * 100_000])
def test_json_that_is_not_an_object(capture: Path, text: str) -> None:
    (capture / "transforms.json").write_text(text, encoding="latin-1")
    with pytest.raises(DataError, match=r"transforms\.json"):
        Nerfstudio().parse(capture, "train")


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        ({"downscale_factor": 0}, "--downscale-factor is 0"),
        ({"eval_interval": -1}, "--eval-interval is -1"),
        ({"scale_factor": 0.0}, "--scale-factor is 0.0"),
        ({"scene_scale": math.inf}, "--scene-scale is inf"),
        ({"near": 2.0, "far": 1.0}, "--near 2.0 and --far 1.0"),
        ({"train_split_fraction": 1.5}, "--train-split-fraction is 1.5"),
        ({"depth_unit_scale_factor": 0.0}, "--depth-unit-scale-factor is 0.0"),
        ({"eval_interval": 1}, "split 'train' has none of the 9 images; --eval-interval 0"),
    ],
)
def test_bad_flags(capture: Path, flags: dict[str, Any], words: str) -> None:
    with pytest.raises(DataError, match=words):
        dataclasses.replace(Nerfstudio(), **flags).parse(capture, "train")


def test_no_folder() -> None:
    with pytest.raises(DataError, match="--data"):
        Nerfstudio().parse(None, "train")


@pytest.mark.data
@pytest.mark.parametrize(("split", "count"), [("train", 43), ("val", 7)])
def test_real_fox(real_data: Path, split: Split, count: int) -> None:
    """instant-ngp's: 1080x1920, reduced to fit 1600; its cube is around the point that the cameras look at."""
    scene = Nerfstudio().parse(real_data / "fox", split)
    data = load_dataset(scene[torch.arange(2)], split)
    assert len(scene.image_paths) == count
    assert data.image(0).shape == (960, 540, 3)
    assert data.cameras.fx[0].item() == pytest.approx(1375.52 / 2)
    assert scene.cameras.lens is not None
    assert scene.cameras.lens[0, :4].tolist() == pytest.approx([0.0578421, -0.0805099, -0.000980296, 0.00015575])
    positions = scene.cameras.camera_to_worlds[:, :, 3]
    assert positions.abs().max() <= 1
    assert ((positions > scene.box[0]) & (positions < scene.box[1])).all()


@pytest.mark.data
def test_real_fox_with_images_missing(real_data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = Nerfstudio().parse(real_data / "fox" / "transforms_original_67frames.json", "train")
    assert len(scene.image_paths) == 43
    assert "17 of 67 images are missing" in capsys.readouterr().err


@pytest.mark.data
@pytest.mark.parametrize(("split", "count"), [("train", 84), ("test", 13)])
def test_real_plush_toy(real_data: Path, split: Split, count: int) -> None:
    scene = Nerfstudio().parse(real_data / "snowmiku", split)
    assert len(scene.image_paths) == count
    assert scene.cameras.model == "opencv"
    sizes = {iio.improps(path).shape for path in scene.image_paths}
    assert sizes == {(378, 504, 3)}
    assert scene.cameras.cx[0].item() == 252
