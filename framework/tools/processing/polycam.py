"""Polycam's raw export: keyframes/images (or corrected_images) with a JSON of pose and lens for each."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from framework.base.console import say
from framework.base.errors import DataError
from framework.tools.processing.phone import UNUSABLE, evenly, finite, read_json, undistorted_lens, write_folder
from framework.tools.processing.photographs import find_photographs
from framework.tools.processing.transforms import Lens

Z_UP = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0]])
"""(3, 4) from the phone's frame, y up, to one with z up, as nerfstudio turns it."""


def convert(export: Path, output: Path, num_downscales: int, most: int, min_blur_score: float, crop: int) -> None:
    """Write the data folder `output`, which has been claimed.

    Args:
        export: the unpacked raw export.
        most: images to take at most, evenly chosen.
        min_blur_score: images with a lower score, as Polycam tells it, are too blurred.
        crop: pixels to cut off at each side.
    Raises: DataError where the export is not one, or nothing of it can be used.
    """
    images, cameras = _folders(export)
    posed, blurred, without = {}, 0, 0
    for name in find_photographs(images):
        path = (cameras / name).with_suffix(".json")
        if not path.is_file():
            without += 1
            continue
        camera = read_json(path)
        if blur_score_of(camera, path, min_blur_score) < min_blur_score:
            blurred += 1
            continue
        posed[name] = (pose_of(camera, path), lens_of(camera, path))
    if without:
        say(f"{without} images have no camera in {cameras} and are skipped")
    if blurred:
        say(f"{blurred} images have a blur score below {min_blur_score:g} and are skipped (--min-blur-score)")
    if not posed:
        raise DataError(f"{export} has no image left to use; lower --min-blur-score, or export again")
    chosen = {name: posed[name] for name in evenly(list(posed), most)}
    write_folder(images, chosen, output, num_downscales, Z_UP, crop)


def check(export: Path) -> None:
    """Raises: DataError where `export` is not an unpacked raw export."""
    _folders(export)


def blur_score_of(camera: dict[str, Any], path: Path, unknown: float) -> float:
    """How sharp Polycam thinks an image is; `unknown` where its JSON does not say.

    Raises: DataError that names `path` where it is no number.
    """
    try:
        return finite(camera.get("blur_score", unknown))
    except UNUSABLE as error:
        raise DataError(f"{path}: the blur_score is not a number") from error


def pose_of(camera: dict[str, Any], path: Path) -> np.ndarray:
    """(4, 4) camera-to-world, OpenGL axes, z up, of a camera's JSON.

    Raises: DataError that names `path` where it is incomplete.
    """
    try:
        rows = [[finite(camera[f"t_{row}{column}"]) for column in range(4)] for row in range(3)]
    except UNUSABLE as error:
        raise DataError(f"{path} has no whole pose (t_00 to t_23)") from error
    pose = np.eye(4)
    pose[:3] = Z_UP[:, :3] @ np.array(rows)
    return pose


def lens_of(camera: dict[str, Any], path: Path) -> Lens:
    """The lens of a camera's JSON.

    Raises: DataError that names `path` where it is incomplete.
    """
    try:
        size = (camera["width"], camera["height"])
        return undistorted_lens(size, [camera[name] for name in ("fx", "fy", "cx", "cy")])
    except UNUSABLE as error:
        raise DataError(f"{path} has no whole lens (width, height, fx, fy, cx, cy)") from error


def _folders(export: Path) -> tuple[Path, Path]:
    """Where images and cameras are; those corrected by Polycam's own adjustment where it made them."""
    if export.is_file():
        raise DataError(f"--data {export} is a file; unpack the raw export and name the folder")
    for root in (export / "keyframes", export):
        for prefix in ("corrected_", ""):
            images, cameras = root / f"{prefix}images", root / f"{prefix}cameras"
            if images.is_dir() and cameras.is_dir():
                return images, cameras
    raise DataError(f"--data {export} is no raw export of Polycam: it has no keyframes/images and keyframes/cameras")
