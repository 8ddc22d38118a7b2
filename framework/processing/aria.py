"""Recordings of Project Aria glasses: images of the colour camera, placed by Machine Perception Services (MPS).

The images come from `vrs extract-all`: STREAM/STREAM-NUMBER-SECONDS.jpg, where the stream 214-1 is the colour camera
and the seconds come from the device's clock. These files of MPS are read (its documentation, Data Formats):

- closed_loop_trajectory.csv: poses of the device in a world with stated gravity, by time in microseconds;
- online_calibration.jsonl: a line for each moment, with lens and place of each camera on the device;
- semidense_points.csv.gz, if it is there: points of the world with standard deviations.

A camera has x right, y down and z forward. The centre of the first pixel is at 0.
"""

from __future__ import annotations

import csv
import gzip
import io
import json
import re
import zlib
from array import array
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from nerfloom.base.console import track_bytes
from nerfloom.base.errors import DataError
from nerfloom.processing.aria_lens import MODEL, NAMES
from nerfloom.processing.capture import Capture, PosedCamera
from nerfloom.processing.finite_numbers import UNUSABLE, bounded, finite_array
from nerfloom.processing.listing import evenly_spaced, find_images
from nerfloom.processing.point_files import GREY, MAX_POINTS
from nerfloom.processing.record3d import rotations
from nerfloom.processing.transforms import Lens, camera_pose, rigid

PROGRAM = "Aria"
"""Name for messages."""
STREAM, LABEL = "214-1", "camera-rgb"
"""Stream of the colour camera in a recording, and its name in calibrations."""
IMAGE = re.compile(r"(\d+-\d+)-\d+-(\d+\.\d+)")
"""Name of an image without ending: stream, number and seconds."""
FOLDERS = ("", "slam", "trajectory")
"""Folders below the results' folder that may have its files."""
FULL, HALF, BORDER = 2880, 1408, 32
"""Side of the colour camera's full images, which calibrations are for, and of half images, pixels; and the border of
full images that half ones lack."""
MAX_GAP = 50_000
"""Maximum time between two poses that a pose is interpolated from, microseconds."""
POSE = tuple(f"{name}_world_device" for name in ("tx", "ty", "tz", "qx", "qy", "qz", "qw"))
"""Columns of a pose: position, and quaternion with the real part last."""
GRAVITY = tuple(f"gravity_{axis}_world" for axis in "xyz")
"""Columns of the gravity."""
POINT = ("px_world", "py_world", "pz_world")
"""Columns of a point."""
DEVIATIONS = {"inv_dist_std": 0.005, "dist_std": 0.01}
"""Columns of a point's standard deviations, and the maxima that MPS's documentation recommends, 1/m and m."""
LINES_OF_PROGRESS = 10_000
"""Number of lines of a table between two reports of progress."""
LEVEL = 0.9998
"""Minimum cosine between z and the direction against gravity for z to be up."""


class Moment(NamedTuple):
    """The device at a time."""

    graph: str
    """Name of the world's frame."""
    pose: np.ndarray
    """(4, 4) device-to-world."""


def read_capture(images: Path, results: Path, most: int) -> Capture:
    """Read the cameras of a recording's images.

    Args:
        images: folder of the extracted images.
        results: folder of MPS's results.
        most: maximum number of images, evenly spaced.

    Returns:
        The capture; the name of a camera is the path of its image in the folder.

    Raises:
        DataError: if there are no such images, or a file is missing or cannot be used.
    """
    times, others = image_times(images)
    trajectory, gravity = poses_at(_found(results, "closed_loop_trajectory.csv"), sorted(set(times.values())))
    graphs = Counter(moment.graph for moment in trajectory.values())
    graph = graphs.most_common(1)[0][0] if graphs else ""
    placed = {name: time for name, time in times.items() if time in trajectory and trajectory[time].graph == graph}
    apart = sum(time in trajectory and trajectory[time].graph != graph for time in times.values())
    left_out = {
        "of other cameras": others,
        "at a time without pose": len(times) - len(placed) - apart,
        "in a part of the trajectory that is not connected": apart,
    }
    chosen = evenly_spaced(sorted(placed, key=lambda name: placed[name]), most)
    if not chosen:
        return Capture(PROGRAM, [], Counter(left_out))
    middle = sorted(placed.values())[len(placed) // 2]
    camera, lens = calibration_at(_found(results, "online_calibration.jsonl"), middle)
    cameras = []
    for name in chosen:
        whole = trajectory[placed[name]].pose @ camera
        cameras.append(PosedCamera(name, camera_pose(whole[:3, :3], whole[:3, 3]), partial(lens_for, lens)))
    up = -gravity / max(float(np.linalg.norm(gravity)), 1e-12)
    points = _points(results, graph)
    colors = None if points is None else np.full(points.shape, GREY, np.uint8)
    return Capture(PROGRAM, cameras, Counter(left_out), points, colors, z_is_up=bool(up[2] >= LEVEL))


def image_times(folder: Path) -> tuple[dict[str, int], int]:
    """Return the time of each image of the colour camera, microseconds, and the number of other images.

    Args:
        folder: folder of the images.

    Raises:
        DataError: if there is no image of that camera.
    """
    times, others = dict[str, int](), 0
    for path in find_images(folder):
        found = IMAGE.fullmatch(path.stem)
        if found is None or found[1] != STREAM:
            others += 1
        else:
            times[path.as_posix()] = round(1e6 * float(found[2]))
    if not times:
        raise DataError(
            f"--data {folder} has no image of Aria's colour camera, such as {STREAM}/{STREAM}-00001-149.203.jpg; "
            "extract them by 'vrs extract-all'"
        )
    return times, others


def poses_at(file: Path, times: Sequence[int]) -> tuple[dict[int, Moment], np.ndarray]:
    """Return the device at times between two of a trajectory's poses, and its gravity (3,), m/s^2.

    Args:
        file: closed_loop_trajectory.csv; it may have a thousand lines for each second.
        times: ascending times, microseconds.

    Raises:
        DataError: if the file cannot be read, lacks a column, or has lines that are not ascending in time.
    """
    found, remaining = dict[int, Moment](), iter(times)
    wanted = next(remaining, None)
    before: tuple[int, str, Sequence[str]] | None = None
    gravity: np.ndarray | None = None
    columns = ("graph_uid", "tracking_timestamp_us", *POSE, *GRAVITY)
    for number, (graph, moment, *values) in _table(file, columns):
        try:
            now = int(moment)
        except ValueError as error:
            raise DataError(f"{file}: line {number}: the time is not a whole number") from error
        if gravity is None:
            gravity = finite_array(values[len(POSE) :], (3,), f"{file}: line {number}: the gravity")
        here = (now, graph, values[: len(POSE)])
        if before is not None and now < before[0]:
            raise DataError(f"{file}: line {number} is of an earlier time than the line before")
        while wanted is not None and wanted <= now:
            start = here if before is None and wanted == now else before
            if start is not None and start[1] == graph and now - start[0] <= MAX_GAP:
                share = (wanted - start[0]) / max(now - start[0], 1)
                found[wanted] = Moment(graph, _between(start[2], here[2], share, f"{file}: line {number}: the pose"))
            wanted = next(remaining, None)
        if wanted is None:
            break
        before = here
    if gravity is None:
        raise DataError(f"{file} has no poses")
    return found, gravity


def calibration_at(file: Path, time: int) -> tuple[np.ndarray, dict[str, float]]:
    """Return the place of the colour camera on the device, (4, 4) camera-to-device, and its lens, near a time.

    Args:
        file: online_calibration.jsonl.
        time: time, microseconds.

    Returns:
        The place, and numbers by the names of `aria_lens.NAMES`, for full images.

    Raises:
        DataError: if the file cannot be read, or has no usable calibration of the camera.
    """
    nearest: int | None = None
    chosen: Any = None
    try:
        with file.open(encoding="utf-8") as stream:
            for line in filter(str.strip, stream):
                record = json.loads(line)
                away = abs(int(record["tracking_timestamp_us"]) - time)
                if nearest is None or away < nearest:
                    nearest, chosen = away, record
        cameras: list[Any] = [] if chosen is None else chosen["CameraCalibrations"]
        named = {camera["Label"]: (camera["Projection"], camera["T_Device_Camera"]) for camera in cameras}
        lens, transform = named[LABEL]
        name, numbers = lens["Name"], lens["Params"]
        place, (real, imaginary) = transform["Translation"], transform["UnitQuaternion"]
        quaternion = [*imaginary, real]
    except OSError as error:
        raise DataError(f"cannot read {file}: {error.strerror or error}") from error
    except (*UNUSABLE, RecursionError) as error:
        raise DataError(f"{file} has no usable calibration of {LABEL}; it must be as MPS writes it") from error
    if name != "FisheyeRadTanThinPrism":
        raise DataError(f"{file}: the lens model of {LABEL} is not FisheyeRadTanThinPrism")
    values = finite_array(numbers, (len(NAMES),), f"{file}: the lens of {LABEL}")
    if not values[0] > 0:
        raise DataError(f"{file}: the focal length of {LABEL} is not above zero")
    rotation = _rotation(finite_array(quaternion, (4,), f"{file}: the rotation of {LABEL}"), str(file))
    pose = rigid(rotation, finite_array(place, (3,), f"{file}: the place of {LABEL}"))
    return pose, dict(zip(NAMES, values.tolist(), strict=True))


def lens_for(values: dict[str, float], width: int, height: int) -> Lens:
    """Return the lens of an image file of the colour camera.

    Args:
        values: numbers of the calibration, for full images.
        width, height: size of the file, pixels.

    Raises:
        DataError: if it has another shape.
    """
    if width != height:
        raise DataError(f"it has {width}x{height} pixels, and Aria's colour images are square: it was cropped")
    border = BORDER if width == HALF else 0
    scale = width / (FULL - 2 * border)
    placed = {"cx": (values["cx"] + 0.5 - border) * scale, "cy": (values["cy"] + 0.5 - border) * scale}
    focal = {name: values["f"] * scale for name in ("fl_x", "fl_y")}
    rest = {name: value for name, value in values.items() if name not in ("f", "cx", "cy")}
    return Lens(MODEL, {"w": width, "h": height, **focal, **placed, **rest})


def _found(results: Path, name: str) -> Path:
    """Return the path of a file of MPS's results."""
    for folder in FOLDERS:
        if (file := results / folder / name).is_file():
            return file
    raise DataError(f"--mps-data-dir {results} has no {name}, neither in it nor in its folder slam")


def _points(results: Path, graph: str) -> np.ndarray | None:
    """Return well-known points (K, 3) of the world named `graph`, evenly spaced in their file; None without."""
    try:
        file = _found(results, "semidense_points.csv.gz")
    except DataError:
        return None
    kept = array("d")  # a recording has millions of points
    for number, (own, *values) in _table(file, ("graph_uid", *POINT, *DEVIATIONS)):
        try:
            row = [bounded(value) for value in values]
        except UNUSABLE as error:
            raise DataError(f"{file}: line {number}: a column is not a number") from error
        if own == graph and all(value <= most for value, most in zip(row[3:], DEVIATIONS.values(), strict=True)):
            kept.extend(row[:3])
    points = np.array(kept).reshape(-1, 3)
    every = -(-len(points) // MAX_POINTS)
    return points[::every] if every else None


def _table(file: Path, columns: Sequence[str]) -> Iterator[tuple[int, list[str]]]:
    """Yield the number of each line of a CSV file, which may be compressed by gzip, and its values of some columns."""
    try:
        with file.open("rb") as raw, track_bytes(f"Reading {file.name}", file.stat().st_size) as advance:
            content: Any = gzip.GzipFile(fileobj=raw) if file.suffix == ".gz" else raw
            rows = csv.reader(io.TextIOWrapper(content, encoding="utf-8-sig", newline=""))
            header = next(rows, [])
            missing = [name for name in columns if name not in header]
            if missing:
                raise DataError(f"{file} has no column {missing[0]}; it must be as MPS writes it")
            places = [header.index(name) for name in columns]
            done = 0
            for number, row in enumerate(rows, 2):
                if number % LINES_OF_PROGRESS == 0:
                    advance(raw.tell() - done)
                    done = raw.tell()
                if row and len(row) < len(header):
                    raise DataError(f"{file}: line {number} has {len(row)} values, and the header {len(header)}")
                if row:
                    yield number, [row[place] for place in places]
    except OSError as error:
        raise DataError(f"cannot read {file}: {error.strerror or error}") from error
    except (EOFError, UnicodeDecodeError, csv.Error, zlib.error) as error:
        raise DataError(f"{file} is damaged: {error}") from error


def _between(start: Sequence[str], end: Sequence[str], share: float, what: str) -> np.ndarray:
    """Return the pose (4, 4) at a `share` of the way between two rows of `POSE`."""
    first, second = (finite_array(values, (7,), what) for values in (start, end))
    turn = second[3:] if float(first[3:] @ second[3:]) >= 0 else -second[3:]
    rotation = _rotation((1 - share) * first[3:] + share * turn, what)
    return rigid(rotation, (1 - share) * first[:3] + share * second[:3])


def _rotation(quaternion: np.ndarray, what: str) -> np.ndarray:
    """Return the rotation (3, 3) of a quaternion (4,) with the real part last."""
    length = float(np.linalg.norm(quaternion))
    if not 0.5 < length < 2:
        raise DataError(f"{what} has a quaternion that is not of unit length")
    return rotations(quaternion[None] / length)[0]
