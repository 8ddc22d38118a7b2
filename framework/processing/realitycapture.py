"""Cameras of RealityCapture and RealityScan: the CSV "Internal/External camera parameters".

Its columns are name, x, y, alt, heading, pitch, roll, f, px, py, k1 to k4, t1 and t2; RealityScan calls some of them
yaw, f_35mm, px_norm and py_norm. With L the longer side of an image, pixels:

- The focal length is f L / 36, f being the focal length for a picture 36 mm wide. The principal point is px L and py L
  from the image's centre: the templates of calibration.xml write `f*36`, `px` and `py`, and in pixels `f*scale` and
  `px*scale+0.5*width`.
- Radial coefficients are Brown's. Templates for OpenCV write k1, k2, t2, t1, k3, k4; so t1 is OpenCV's
  p2, and t2 its p1.
- With heading, pitch and roll 0 the camera looks straight down, and north is up in the image. The rotation from the
  camera with OpenGL axes is Rz(-heading) Rx(pitch) Ry(roll); angles are in degrees.
"""

from __future__ import annotations

import csv
import math
from collections import Counter
from functools import partial
from pathlib import Path

import numpy as np

from nerfloom.base.errors import DataError, shown
from nerfloom.processing.capture import Capture, PosedCamera, near_origin, relative_name
from nerfloom.processing.finite_numbers import UNUSABLE, bounded
from nerfloom.processing.transforms import Lens, rigid

PROGRAM = "RealityCapture"
"""Name for messages."""
FILM = 36.0
"""Longer side of the picture that f is for, mm."""
NAMES = {"yaw": "heading", "f_35mm": "f", "px_norm": "px", "py_norm": "py"}
"""RealityScan's name of a column -> RealityCapture's."""
POSE = ("x", "y", "alt", "heading", "pitch", "roll", "f")
"""Columns of numbers that are needed."""
LENS = ("px", "py", "k1", "k2", "k3", "k4", "t1", "t2")
"""Columns of numbers that may be missing, which are 0 then."""
STEEP, AWAY = 10.0, 100.0
"""Positions in degrees have at least these ratios: spread of heights, and distance from 0, over spread of x and y."""


EXPORT = "export 'Internal/External camera parameters' from RealityCapture"
"""Advice for the user."""


def read_capture(file: Path) -> Capture:
    """Read cameras from the CSV `file`.

    Raises:
        DataError: if the file cannot be read, lacks a column, has a number that is not one, or positions in degrees.
    """
    rows = _rows(file)
    start = next((i for i, (_, row) in enumerate(rows) if _column(row[0]) == "name" and len(row) > 1), None)
    if start is None:
        raise DataError(f"{file} has no line that begins with '#name' and names columns; {EXPORT}")
    columns = [_column(name) for name in rows[start][1]]
    missing = [name for name in POSE if name not in columns]
    if missing:
        raise DataError(f"{file} has no column {missing[0]!r}; {EXPORT}")
    cameras = [_camera(columns, row, f"{file}: line {line}") for line, row in rows[start + 1 :]]
    _check_lengths(cameras, file)
    return Capture(PROGRAM, cameras, Counter(), z_is_up=True, frame=near_origin(cameras))


def lens_for(values: dict[str, float], width: int, height: int) -> Lens:
    """Return the lens of an image of `width` x `height` pixels, from the `values` of columns by their names."""
    longer = max(width, height)
    focal = values["f"] * longer / FILM
    return Lens(
        "OPENCV",
        {
            "w": width, "h": height, "fl_x": focal, "fl_y": focal,
            "cx": width / 2 + values["px"] * longer, "cy": height / 2 + values["py"] * longer,
            **{key: values[key] for key in ("k1", "k2", "k3", "k4")},
            "p1": values["t2"], "p2": values["t1"],
        },
    )  # fmt: skip


def rotation_of(heading: float, pitch: float, roll: float) -> np.ndarray:
    """Return the rotation (3, 3) from a camera with OpenGL axes to the world; angles are in degrees.

    Args:
        heading: angle from north to east.
        pitch: angle upwards from straight down.
        roll: angle about the direction that is up in the image of a camera that looks down.
    """
    a, b, c = (math.radians(angle) for angle in (-heading, pitch, roll))
    around = np.array([[math.cos(a), -math.sin(a), 0], [math.sin(a), math.cos(a), 0], [0, 0, 1]])
    tilted = np.array([[1, 0, 0], [0, math.cos(b), -math.sin(b)], [0, math.sin(b), math.cos(b)]])
    rolled = np.array([[math.cos(c), 0, math.sin(c)], [0, 1, 0], [-math.sin(c), 0, math.cos(c)]])
    return around @ tilted @ rolled


def _check_lengths(cameras: list[PosedCamera], file: Path) -> None:
    """Check that x and y are not degrees of longitude and latitude, which RealityScan writes for EPSG:4326.

    A degree has 111 km, so such cameras are close together, far from 0, and much farther apart in height.
    """
    if len(cameras) < 2:
        return
    places = np.stack([camera.pose[:3, 3] for camera in cameras])
    centre = places.mean(0)
    x, y, height = places.std(0)
    across = float(np.hypot(x, y))
    degrees = (np.abs(places[:, :2]) <= [180, 90]).all()
    if degrees and height > STEEP * across and float(np.linalg.norm(centre[:2])) > AWAY * across:
        raise DataError(
            f"{file}: x and y seem to be degrees of longitude and latitude, not lengths; export the cameras in a "
            "coordinate system in metres, such as local:1 or UTM"
        )


def _rows(file: Path) -> list[tuple[int, list[str]]]:
    """Return number and fields of the lines that are not empty."""
    try:
        lines = file.read_text(encoding="utf-8-sig").splitlines()
        return [(number + 1, next(csv.reader([line]))) for number, line in enumerate(lines) if line.strip()]
    except OSError as error:
        raise DataError(f"cannot read {file}: {error.strerror}") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise DataError(f"{file} is not a CSV: {error}") from error


def _column(name: str) -> str:
    plain = name.strip().lstrip("#").strip().lower()
    return NAMES.get(plain, plain)


def _camera(columns: list[str], fields: list[str], where: str) -> PosedCamera:
    if any(field.strip() for field in fields[len(columns) :]):
        raise DataError(
            f"{where} has {len(fields)} fields, and its header {len(columns)}; numbers need decimal points, and names "
            "with commas quotation marks"
        )
    row = dict(zip(columns, fields, strict=False))
    try:
        values = {name: bounded(row[name]) for name in POSE} | {name: bounded(row.get(name) or 0) for name in LENS}
    except UNUSABLE as error:
        raise DataError(f"{where}: a column of {', '.join(POSE + LENS)} is not a number") from error
    if values["f"] <= 0:
        raise DataError(f"{where}: the focal length f is {values['f']:g}; it must be above zero")
    if not (name := relative_name(row.get("name", ""))):
        raise DataError(f"{where}: {shown(row.get('name'))} is not the name of an image")
    rotation = rotation_of(values["heading"], values["pitch"], values["roll"])
    pose = rigid(rotation, np.array([values["x"], values["y"], values["alt"]]))
    return PosedCamera(name, pose, partial(lens_for, values))
