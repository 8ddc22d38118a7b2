"""Cameras as nerfstudio's transforms.json: poses, intrinsics, lenses, and the lists of each split's images."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

import torch

from nerfloom.base.json_files import write_json
from nerfloom.data.ply import write_points
from nerfloom.export.cameras import SPLITS, PosedFiles, coefficients, rational

OPENCV = {"k1": "k1", "k2": "k2", "p1": "p1", "p2": "p2", "k3": "k3", "k4": "k7"}
"""Coefficient of the file -> coefficient of `LENSES["opencv"]`; the file's k4 is the r^8 term."""
RATIONAL = {name: name for name in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")}
"""Coefficients of COLMAP's FULL_OPENCV, in the same way, with k4 to k6 in the denominator."""
FISHEYE = {name: name for name in ("k1", "k2", "k3", "k4")}
"""Coefficients of a fisheye lens, in the same way."""
POINTS = "sparse_pc.ply"
"""Name of the file of sparse points beside the JSON file."""


def write_transforms(file: Path, posed: PosedFiles, relative: bool) -> None:
    """Write the images `posed` to transforms.json, `file`, and points beside it; `relative` as in `transforms`.

    Raises:
        ConfigError: as `transforms`.
        OSError: if a file cannot be written.
    """
    content = transforms(posed, file.parent, relative)
    file.parent.mkdir(parents=True, exist_ok=True)
    if posed.points is not None:
        write_points(file.with_name(POINTS), posed.points, torch.full_like(posed.points, 0.5))
    write_json(file, content)


def transforms(posed: PosedFiles, folder: Path, relative: bool) -> dict[str, Any]:
    """Return the content of transforms.json.

    Numbers that all images share are stored once in the file, all others in each frame.

    Args:
        posed: the images.
        folder: folder that the file will be in.
        relative: True for paths relative to it, False for absolute ones.

    Raises:
        ConfigError: if the lens has more coefficients than the file.
    """
    names = [_path(file, folder, relative) for file in posed.files]
    model, numbers = _intrinsics(posed)
    shared = {key: value for key, value in numbers[0].items() if all(row[key] == value for row in numbers)}
    frames = []
    for index, name in enumerate(names):
        frame: dict[str, Any] = {"file_path": name}
        if posed.times is not None:
            frame["time"] = float(posed.times[index])
        if (mask := posed.masks[index]) is not None:
            frame["mask_path"] = _path(mask, folder, relative)
        frame |= {key: value for key, value in numbers[index].items() if key not in shared}
        frame["transform_matrix"] = [*posed.poses[index].tolist(), [0.0, 0.0, 0.0, 1.0]]
        frames.append(frame)
    content: dict[str, Any] = {"camera_model": model, **shared}
    for split in SPLITS:
        if split in posed.splits:
            content[f"{split}_filenames"] = [names[index] for index in posed.splits[split]]
    if posed.points is not None:
        content["ply_file_path"] = POINTS
    return {**content, "frames": frames}


def _path(file: Path, folder: Path, relative: bool) -> str:
    """Return the path of a file as JSON holds it, with forward slashes."""
    file = file.resolve()
    return Path(os.path.relpath(file, folder.resolve()) if relative else file).as_posix()


def _intrinsics(posed: PosedFiles) -> tuple[str, list[dict[str, float | int]]]:
    """Return the file's camera model, and the numbers of each image."""
    cameras, lenses = posed.cameras, coefficients(posed.cameras)
    model, names = "OPENCV", OPENCV
    factor = 1.0
    if cameras.model == "pinhole":
        model, names = "PINHOLE", {}
    elif cameras.model == "fisheye":
        model, names = "OPENCV_FISHEYE", FISHEYE
    elif cameras.model == "equirectangular":  # in the file, half the width of a whole panorama
        model, names, factor = "EQUIRECTANGULAR", {}, math.pi
    elif cameras.model == "orthographic":
        model, names, factor = "ORTHOPHOTO", {}, posed.pixels_per_unit
    elif rational(lenses):
        model, names = "FULL_OPENCV", RATIONAL
    rows: list[dict[str, float | int]] = []
    for index, lens in enumerate(lenses):
        rows.append(
            {
                "w": int(cameras.widths[index]),
                "h": int(cameras.heights[index]),
                "fl_x": float(cameras.fx[index]) * factor,
                "fl_y": float(cameras.fy[index]) * factor,
                "cx": float(cameras.cx[index]),
                "cy": float(cameras.cy[index]),
                **{name: lens[own] for name, own in names.items()},
            }
        )
    return model, rows
