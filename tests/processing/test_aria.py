"""Recordings of Project Aria glasses, made as its tools write them: poses, lens and points are known."""

import gzip
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from nerfloom.base.errors import DataError, FlagError
from nerfloom.data.ply import read_points
from nerfloom.processing import aria
from nerfloom.processing.aria_lens import NAMES, reach
from nerfloom.processing.kinds import process
from nerfloom.processing.settings import AriaFlags
from nerfloom.processing.views import positions, view_lens

PARAMS = [
    1220.0, 1461.1, 1447.1, 0.411, -0.4565, 0.0383, 1.2983, -1.7705, 0.655,
    -8e-3, 4e-3, -5.9e-3, 5.6e-3, 5.2e-3, 2.4e-3,
]  # fmt: skip
"""A lens like the glasses', with larger tangential and thin-prism terms."""
SIDE, COUNT, START = 240, 6, 149_202_610
GRAPH = "ea7288b8-b6a0-012d-8156-257aba6bd796"
CAMERA = ([0.9416, [0.3325, 0.034, 0.0417]], [-0.004, -0.0119, -0.0044])
"""Quaternion, real part first, and place of the camera on the device."""
HEADER = (
    "graph_uid,tracking_timestamp_us,utc_timestamp_ns,tx_world_device,ty_world_device,tz_world_device,qx_world_device,"
    "qy_world_device,qz_world_device,qw_world_device,device_linear_velocity_x_device,gravity_x_world,gravity_y_world,"
    "gravity_z_world,quality_score"
)


def rotation(quaternion: Any) -> np.ndarray:
    """(3, 3) of w, x, y, z, by the exponential of its axis and angle."""
    w, *axis = np.array(quaternion) / np.linalg.norm(quaternion)
    angle, unit = 2 * math.acos(w), np.array(axis) / max(np.linalg.norm(axis), 1e-12)
    x, y, z = unit
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


def device_at(seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Quaternion w, x, y, z and position of the device, in steady motion."""
    angle = 0.4 + 0.8 * seconds
    axis = np.array([0.2, -0.5, 0.84]) / np.linalg.norm([0.2, -0.5, 0.84])
    return np.array([math.cos(angle / 2), *(math.sin(angle / 2) * axis)]), np.array(
        [0.3, -1.1, 1.6]
    ) + seconds * np.array([0.5, 0.2, -0.1])


def camera_at(seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (3, 3) camera-to-world, x right, y down, z forward, and position."""
    (quaternion, place), ((real, imaginary), inside) = device_at(seconds), CAMERA
    turn = rotation(quaternion)
    return turn @ rotation([real, *imaginary]), place + turn @ np.array(inside)


def pixels(points: np.ndarray, side: int = SIDE) -> np.ndarray:
    """(K, 2) where an image of a side shows points in the camera's frame, the first pixel's centre at 0."""
    f, cx, cy, *rest = PARAMS
    k, (p0, p1), (s0, s1, s2, s3) = rest[:6], rest[6:8], rest[8:]
    a, b = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    r = np.hypot(a, b)
    t = np.arctan(r)
    far = t + k[0] * t**3 + k[1] * t**5 + k[2] * t**7 + k[3] * t**9 + k[4] * t**11 + k[5] * t**13
    x, y = far * a / r, far * b / r
    q = x * x + y * y
    u = x + (2 * x * x + q) * p0 + 2 * x * y * p1 + s0 * q + s1 * q * q
    v = y + (2 * y * y + q) * p1 + 2 * x * y * p0 + s2 * q + s3 * q * q
    scale = side / 2880
    return np.stack([scale * (f * u + cx + 0.5) - 0.5, scale * (f * v + cy + 0.5) - 0.5], -1)


def row(seconds: float, graph: str = GRAPH, gravity: str = "0.0,0.0,-9.81") -> str:
    (w, x, y, z), place = device_at(seconds)
    numbers = ",".join(f"{value:.9f}" for value in (*place, x, y, z, w))
    return f"{graph},{START + round(1e6 * seconds)},1686767222002923694,{numbers},0.01,{gravity},0.5"


def record(time: int) -> str:
    """A line of online_calibration.jsonl; the other camera comes first."""
    (real, imaginary), place = CAMERA
    transform = {"Translation": place, "UnitQuaternion": [real, imaginary]}
    projection = {"Params": PARAMS, "Description": "see FisheyeRadTanThinPrism.h", "Name": "FisheyeRadTanThinPrism"}
    other = {
        "Label": "camera-slam-left",
        "Projection": {**projection, "Params": PARAMS[::-1]},
        "T_Device_Camera": transform,
    }
    ours = {"Label": "camera-rgb", "Projection": projection, "T_Device_Camera": transform, "Calibrated": True}
    return json.dumps({"tracking_timestamp_us": time, "utc_timestamp_ns": -1, "CameraCalibrations": [other, ours]})


def seconds_of(index: int) -> float:
    """When an image is taken, between two poses of the trajectory; names have milliseconds."""
    return round((START + 13_000 + 50_400 * index) / 1e3) / 1e3 - START / 1e6


def write_recording(folder: Path, paint: Callable[[int], np.ndarray] | None = None) -> tuple[Path, Path]:
    images, results = folder / "images", folder / "mps"
    for path in (images / "214-1", images / "1201-1", results / "slam"):
        path.mkdir(parents=True)
    for index in range(COUNT):
        shades = np.full((SIDE, SIDE, 3), 90, np.uint8) if paint is None else paint(index)
        name = f"214-1-{index + 1:05d}-{START / 1e6 + seconds_of(index):.3f}.png"
        Image.fromarray(shades).save(images / "214-1" / name)
    Image.fromarray(np.zeros((48, 64), np.uint8)).save(images / "1201-1" / "1201-1-00001-149.210.png")
    lines = [row(0.0015 * step) for step in range(300)]
    (results / "slam" / "closed_loop_trajectory.csv").write_text("\n".join([HEADER, *lines]) + "\n")
    (results / "slam" / "online_calibration.jsonl").write_text("\n".join(map(record, (START, START + 150_000))) + "\n")
    rows = [
        f"1,{GRAPH},0.5,0.25,1.5,0.001,0.002",
        f"2,{GRAPH},9,9,9,0.1,0.002",
        f"3,{GRAPH},9,9,9,0.001,0.2",
        "4,x,9,9,9,0,0",
    ]
    table = "\n".join(["uid,graph_uid,px_world,py_world,pz_world,inv_dist_std,dist_std", *rows])
    (results / "slam" / "semidense_points.csv.gz").write_bytes(gzip.compress(table.encode()))
    return images, results


def converted(folder: Path, **changes: Any) -> dict[str, Any]:
    """The content of the data folder's transforms.json."""
    output = folder / "out"
    process(
        "aria",
        AriaFlags(data=folder / "images", mps_data_dir=folder / "mps", output_dir=output, num_downscales=0, **changes),
    )
    return json.loads((output / "transforms.json").read_text())


def test_poses_points_and_what_is_up(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_recording(tmp_path)
    found = converted(tmp_path)
    assert len(found["frames"]) == COUNT
    for index, frame in enumerate(found["frames"]):
        turn, place = camera_at(seconds_of(index))
        expected = np.concatenate([turn * [1, -1, -1], place[:, None]], 1)  # OpenGL axes
        np.testing.assert_allclose(np.array(frame["transform_matrix"])[:3], expected, atol=2e-5)
    assert found["orientation_override"] == "none"
    points = read_points(tmp_path / "out" / found["ply_file_path"])
    np.testing.assert_allclose(np.asarray(points)[:, :3], [[0.5, 0.25, 1.5]], atol=1e-6)
    said = " ".join(capsys.readouterr().err.split())
    assert "Aria: 6 of 7 cameras are placed (left out: 1 of other cameras)" in said


def test_views_show_what_the_lens_shows() -> None:
    """Each pixel of a view is where the lens of the glasses shows its direction."""
    lens = aria.lens_for(dict(zip(NAMES, PARAMS, strict=True)), SIDE, SIDE)
    view = view_lens(lens, 120.0)
    side, focal = int(view.values["w"]), view.values["fl_x"]
    columns, rows, inside = positions(lens, view, np.eye(3), slice(0, side))
    down, across = np.mgrid[:side, :side] + 0.5
    x, y = (across - side / 2) / focal, (down - side / 2) / focal
    truth = (
        pixels(np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)) + 0.5
    )  # the first pixel's centre is at 0.5 here
    np.testing.assert_allclose(columns.reshape(-1), truth[:, 0], atol=1e-9)
    np.testing.assert_allclose(rows.reshape(-1), truth[:, 1], atol=1e-9)
    within = ((truth >= 0) & (truth <= SIDE)).all(1)
    assert 0.7 < within.mean() < 1
    np.testing.assert_array_equal(inside.reshape(-1), within)


def test_a_point_is_where_the_poses_say(tmp_path: Path) -> None:
    """A bright spot that the glasses see is at the pinhole projection of its point in the views."""
    turn, place = camera_at(seconds_of(2))
    point = place + turn @ np.array([0.5, -0.3, 2.0])

    def paint(index: int) -> np.ndarray:
        turn, place = camera_at(seconds_of(index))
        (u, v) = pixels(((point - place) @ turn)[None])[0]
        rows, columns = np.mgrid[:SIDE, :SIDE]
        spot = np.exp(-((columns - u) ** 2 + (rows - v) ** 2) / (2 * 3.0**2))
        return np.repeat((250 * spot).round().astype(np.uint8)[..., None], 3, -1)

    write_recording(tmp_path, paint)
    found = converted(tmp_path)
    for frame in found["frames"]:
        lens = found | frame
        pose = np.array(frame["transform_matrix"])
        x, y, z = (point - pose[:3, 3]) @ pose[:3, :3]
        expected = [lens["cx"] + lens["fl_x"] * x / -z - 0.5, lens["cy"] - lens["fl_y"] * y / -z - 0.5]
        image = np.asarray(Image.open(tmp_path / "out" / frame["file_path"]), float)[..., 0]
        rows, columns = np.mgrid[: image.shape[0], : image.shape[1]]
        center = [(image * columns).sum() / image.sum(), (image * rows).sum() / image.sum()]
        np.testing.assert_allclose(center, expected, atol=0.4)


def test_images_of_half_the_size_lack_a_border() -> None:
    values = dict(zip(NAMES, PARAMS, strict=True))
    half, full = aria.lens_for(values, 1408, 1408), aria.lens_for(values, 2880, 2880)
    assert full.values["cx"] == pytest.approx(1461.6)
    assert half.values["cx"] == pytest.approx((1461.6 - 32) / 2)
    assert half.values["fl_x"] == pytest.approx(610)
    with pytest.raises(DataError, match="square"):
        aria.lens_for(values, 640, 480)


def test_a_lens_ends_where_its_radius_stops_growing() -> None:
    assert reach(dict.fromkeys(NAMES, 0.0)) == math.pi
    values = dict.fromkeys(NAMES, 0.0) | {"k1": -0.25}  # the slope is 1 - 0.75 t^2
    assert reach(values) == pytest.approx(math.sqrt(4 / 3), abs=0.004)


def test_few_images_are_taken_evenly(tmp_path: Path) -> None:
    write_recording(tmp_path)
    assert len(converted(tmp_path, max_dataset_size=2)["frames"]) == 2
    with pytest.raises(FlagError, match="--max-dataset-size"):
        converted(tmp_path, max_dataset_size=1)


def test_times_without_pose_and_parts_apart_are_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _, results = write_recording(tmp_path)
    file = results / "slam" / "closed_loop_trajectory.csv"
    lines = [row(0.0015 * step, GRAPH if step < 130 else "other") for step in range(160)]  # to 0.24 s
    file.write_text("\n".join([HEADER, *lines]))
    assert len(converted(tmp_path)["frames"]) == 4
    said = " ".join(capsys.readouterr().err.split())
    assert "1 at a time without pose, 1 in a part of the trajectory that is not connected" in said


def test_gravity_that_is_not_along_z_is_not_up(tmp_path: Path) -> None:
    _, results = write_recording(tmp_path)
    lines = [row(0.0015 * step, gravity="0.0,-9.81,0.0") for step in range(300)]
    (results / "slam" / "closed_loop_trajectory.csv").write_text("\n".join([HEADER, *lines]))
    assert "orientation_override" not in converted(tmp_path)


BROKEN: dict[str, tuple[str, Callable[[str], str]]] = {
    "no column qw_world_device": ("closed_loop_trajectory.csv", lambda text: text.replace("qw_world_device", "q")),
    "not a whole number": ("closed_loop_trajectory.csv", lambda text: text.replace(f",{START},", ",soon,")),
    "of an earlier time": (
        "closed_loop_trajectory.csv",
        lambda text: text.replace(f",{START + 1500},", f",{START - 1},"),
    ),
    "must be 3 finite numbers": ("closed_loop_trajectory.csv", lambda text: text.replace("-9.81", "nan")),
    "values, and the header": ("closed_loop_trajectory.csv", lambda text: text.replace(",0.5\n", "\n")),
    "has no poses": ("closed_loop_trajectory.csv", lambda text: HEADER),
    "no usable calibration": ("online_calibration.jsonl", lambda text: text.replace("camera-rgb", "camera-et")),
    "no usable calibration of camera-rgb": ("online_calibration.jsonl", lambda text: "[1]\n"),
    "is not FisheyeRadTanThinPrism": (
        "online_calibration.jsonl",
        lambda text: text.replace('"Name": "FisheyeRadTanThinPrism"', '"Name": "Linear"'),
    ),
    "must be 15 finite numbers": ("online_calibration.jsonl", lambda text: text.replace("1220.0, ", "")),
    "not above zero": ("online_calibration.jsonl", lambda text: text.replace("1220.0, ", "-1220.0, ")),
    "not of unit length": ("online_calibration.jsonl", lambda text: text.replace("0.9416", "9.416")),
}


@pytest.mark.parametrize("message", BROKEN)
def test_broken_results_are_refused_in_a_line(message: str, tmp_path: Path) -> None:
    _, results = write_recording(tmp_path)
    name, change = BROKEN[message]
    file = results / "slam" / name
    file.write_text(change(file.read_text()))
    with pytest.raises(DataError, match=message) as error:
        converted(tmp_path)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "out").exists()


def test_what_is_not_a_recording_is_refused(tmp_path: Path) -> None:
    images, results = write_recording(tmp_path)
    (results / "slam" / "semidense_points.csv.gz").write_bytes(b"not gzip")
    with pytest.raises(DataError, match="semidense_points"):
        converted(tmp_path)
    (results / "slam" / "closed_loop_trajectory.csv").unlink()
    with pytest.raises(DataError, match=r"has no closed_loop_trajectory\.csv"):
        converted(tmp_path)
    for file in (images / "214-1").iterdir():
        file.unlink()
    with pytest.raises(DataError, match="no image of Aria's colour camera"):
        converted(tmp_path)
