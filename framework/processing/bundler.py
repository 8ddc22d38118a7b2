"""Reconstructions of Bundler (Snavely et al. 2006): bundle.out of version 0.3, and a list of the images.

The file gives focal length f, k1 and k2, rotation R and translation t of each camera, which looks along -z with y up. A
point X is at P = R X + t, at p = -P / P.z on the image plane, and at f (1 + k1 |p|^2 + k2 |p|^4) p pixels from the
image's centre, x to the right and y up (Bundler's user manual).
"""

from __future__ import annotations

import re
from collections import Counter
from functools import partial
from pathlib import Path

import numpy as np

from nerfloom.base.errors import DataError
from nerfloom.processing.capture import Capture, PosedCamera, near_origin, relative_name
from nerfloom.processing.finite_numbers import finite_array, nearest_rotation
from nerfloom.processing.transforms import Lens, rigid

PROGRAM = "Bundler"
"""Name for messages."""
HEADER = "# Bundle file v0.3"
"""First line."""
LINES_OF_CAMERA, LINES_OF_POINT = 5, 3
"""Number of lines of a camera: f, k1 and k2; three rows of R; t. And of a point: position; colour; its images."""
LISTS = ("list.txt", "{}.list.txt", "../list.txt")
"""Paths of the list of images from the folder of the reconstruction. COLMAP writes NAME.bundle.out and NAME.list.txt,
Bundler bundle/bundle.out and list.txt."""
_WITH_FOCAL = re.compile(r"^(.*\S)\s+0\s+[\d.eE+-]+$")
"""A line of the list that states a focal length after the name."""


def find_list(file: Path) -> Path:
    """Return the path of the list of images of `file`, a bundle.out.

    Raises:
        DataError: if there is no list.
    """
    name = file.name.removesuffix(".out").removesuffix(".bundle")
    for place in LISTS:
        if (found := file.parent / place.format(name)).is_file():
            return found
    raise DataError(f"{file.parent} has no list.txt; name the list of the images by --image-list")


def read_capture(file: Path, listed: Path) -> Capture:
    """Read cameras and points of `file`, a bundle.out; `listed` has the images' names in the cameras' order.

    Raises:
        DataError: if a file cannot be read, is truncated, or has an invalid number.
    """
    lines = _lines(file)
    if not lines or lines[0].strip() != HEADER:
        raise DataError(f"{file} is not a reconstruction of Bundler: its first line is not '{HEADER}'")
    cameras, points = _counts(lines, file)
    names = [relative_name(_WITH_FOCAL.sub(r"\1", line.strip())) for line in _lines(listed)]
    if len(names) < cameras:
        raise DataError(f"{listed} lists {len(names)} images, but {file} has {cameras} cameras")
    found: list[PosedCamera] = []
    left_out: Counter[str] = Counter()
    for index in range(cameras):
        start = 2 + LINES_OF_CAMERA * index
        rows = [line.split() for line in lines[start : start + LINES_OF_CAMERA]]
        camera = _camera(names[index], rows, f"{file}: camera {index}")
        if camera is None:
            left_out["not aligned"] += 1
        else:
            found.append(camera)
    start = 2 + LINES_OF_CAMERA * cameras
    kept = [line.split() for line in lines[start : start + LINES_OF_POINT * points]]
    frame = near_origin(found)
    if not points:
        return Capture(PROGRAM, found, left_out, frame=frame)
    positions = finite_array(kept[::LINES_OF_POINT], (points, 3), f"{file}: the points' positions")
    colors = finite_array(kept[1::LINES_OF_POINT], (points, 3), f"{file}: the points' colours")
    return Capture(PROGRAM, found, left_out, positions, colors.clip(0, 255).astype(np.uint8), frame=frame)


def lens_for(focal: float, k1: float, k2: float, width: int, height: int) -> Lens:
    """Return the lens of an image, with the principal point at its centre.

    Args:
        focal: focal length, pixels.
        k1: coefficient of r^2.
        k2: coefficient of r^4.
        width, height: size of the image, pixels.
    """
    values = {"w": width, "h": height, "fl_x": focal, "fl_y": focal, "cx": width / 2, "cy": height / 2}
    return Lens("OPENCV", {**values, "k1": k1, "k2": k2})


def _lines(file: Path) -> list[str]:
    """Return the lines of a text that are not empty."""
    try:
        return [line for line in file.read_text(encoding="utf-8-sig").splitlines() if line.strip()]
    except OSError as error:
        raise DataError(f"cannot read {file}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise DataError(f"{file} is not a text: {error}") from error


def _counts(lines: list[str], file: Path) -> tuple[int, int]:
    """Return the numbers of cameras and points, and check that there are enough lines for them."""
    words = lines[1].split() if len(lines) > 1 else []
    if len(words) != 2 or not all(word.isdecimal() and len(word) < 10 for word in words):
        raise DataError(f"{file}: its second line is not the number of cameras and of points")
    cameras, points = map(int, words)
    if 2 + LINES_OF_CAMERA * cameras + LINES_OF_POINT * points > len(lines):
        raise DataError(f"{file} is truncated: it states {cameras} cameras and {points} points in {len(lines)} lines")
    return cameras, points


def _camera(name: str, rows: list[list[str]], where: str) -> PosedCamera | None:
    """Return a camera; None if it was not placed, so that its focal length is 0."""
    focal, k1, k2 = finite_array(rows[0], (3,), f"{where}: focal length, k1 and k2").tolist()
    if focal <= 0:
        return None
    rotation = nearest_rotation(finite_array(rows[1:4], (3, 3), f"{where}: R"), f"{where}: R")
    translation = finite_array(rows[4], (3,), f"{where}: t")
    pose = rigid(rotation.T, -rotation.T @ translation)
    return PosedCamera(name, pose, partial(lens_for, focal, k1, k2))
