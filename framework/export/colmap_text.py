"""Cameras as a COLMAP model in text files: cameras.txt, images.txt and points3D.txt (Schönberger and Frahm 2016)."""

from __future__ import annotations

import os
from pathlib import Path

import torch

from nerfloom.base.atomic import write_atomically
from nerfloom.base.errors import ConfigError
from nerfloom.export.cameras import PosedFiles, coefficients, rational
from nerfloom.splats.transform import quaternion

ORDERS = {
    "PINHOLE": (),
    "OPENCV": ("k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
}
"""COLMAP's model -> its coefficients after fx, fy, cx, cy, by their names in `LENSES`."""


def images_folder(posed: PosedFiles) -> Path:
    """Return the common folder of the image files of `posed`; names in the model are relative to it."""
    return Path(os.path.commonpath([file.resolve().parent for file in posed.files]))


def write_model(folder: Path, posed: PosedFiles) -> None:
    """Write the three files of a model.

    Images have no keypoints and points have no observations, since only the positions of points are known.

    Args:
        folder: folder to write to, which is created.
        posed: the images.

    Raises:
        ConfigError: if COLMAP has no such camera model.
        OSError: if a file cannot be written.
    """
    cameras, owners = _cameras(posed)
    root = images_folder(posed)
    lines = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME, and a line of keypoints"]
    for index, (file, pose) in enumerate(zip(posed.files, posed.poses, strict=True)):
        # COLMAP looks along +z, with y down, and stores the inverse.
        rotation = (pose[:, :3] * torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)).T
        numbers = [*quaternion(rotation).tolist(), *(-rotation @ pose[:, 3]).tolist()]
        name = file.resolve().relative_to(root).as_posix()
        lines += [f"{index + 1} {' '.join(map(repr, numbers))} {owners[index] + 1} {name}", ""]
    points = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]"]
    for index, point in enumerate([] if posed.points is None else posed.points.tolist()):
        points.append(f"{index + 1} {' '.join(map(repr, point))} 128 128 128 0")
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in (("cameras", cameras), ("images", lines), ("points3D", points)):
        text = "\n".join(content) + "\n"
        write_atomically(folder / f"{name}.txt", lambda stream, text=text: stream.write(text.encode()))  # type: ignore[misc]


def _cameras(posed: PosedFiles) -> tuple[list[str], list[int]]:
    """Return the lines of cameras.txt, and the number of each image's camera, from 0."""
    cameras, lenses = posed.cameras, coefficients(posed.cameras)
    if cameras.model not in ("pinhole", "opencv", "fisheye"):
        raise ConfigError(f"COLMAP has no {cameras.model} cameras")
    model = {"pinhole": "PINHOLE", "opencv": "OPENCV", "fisheye": "OPENCV_FISHEYE"}[cameras.model]
    if cameras.model == "opencv":
        full = rational(lenses) or any(lens["k3"] for lens in lenses)
        if any(lens["k7"] for lens in lenses):
            raise ConfigError("COLMAP's camera models have no r^8 term")
        model = "FULL_OPENCV" if full else "OPENCV"
    numbers: dict[str, int] = {}
    owners = []
    for index, lens in enumerate(lenses):
        values = [float(part[index]) for part in (cameras.fx, cameras.fy, cameras.cx, cameras.cy)]
        values += [lens[name] for name in ORDERS[model]]
        line = f"{model} {int(cameras.widths[index])} {int(cameras.heights[index])} {' '.join(map(repr, values))}"
        owners.append(numbers.setdefault(line, len(numbers)))
    header = "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"
    return [header, *(f"{number + 1} {line}" for line, number in numbers.items())], owners
