"""Polycam's raw exports: keyframes/images (or corrected_images), with a JSON file of pose and lens per image.

An export is a folder, or the zip file that Polycam makes of it.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from nerfloom.base.console import say
from nerfloom.base.errors import DataError
from nerfloom.base.json_files import read_object
from nerfloom.processing.capture import Capture, PosedCamera, for_size_of, undistorted_lens
from nerfloom.processing.finite_numbers import UNUSABLE, finite
from nerfloom.processing.listing import evenly_spaced, find_images
from nerfloom.processing.transforms import Lens

PROGRAM = "Polycam"
"""Name for messages."""
Z_UP = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0]])
"""(3, 4) transform from the phone's frame (y up) to one with z up, as in nerfstudio."""
FOLDERS = ("images", "cameras", "corrected_images", "corrected_cameras")
"""Folders in keyframes that are read."""


def read_capture(images: Path, cameras: Path, max_images: int, min_blur_score: float) -> Capture:
    """Read the cameras of an export; the name of a camera is the path of its image.

    Args:
        images, cameras: folders of the export, from `folders_of`.
        max_images: maximum number of images, evenly spaced.
        min_blur_score: minimum of Polycam's blur score; images with a lower score are skipped as blurred.

    Raises:
        DataError: if a camera is invalid, or no image is usable.
    """
    found, blurred, without_camera = list[PosedCamera](), 0, 0
    for name in find_images(images):
        path = (cameras / name).with_suffix(".json")
        if not path.is_file():
            without_camera += 1
            continue
        camera = read_object(path)
        if blur_score_of(camera, path, min_blur_score) < min_blur_score:
            blurred += 1
            continue
        found.append(PosedCamera(name.as_posix(), pose_of(camera, path), for_size_of(lens_of(camera, path))))
    if without_camera:
        say(f"{without_camera} images have no camera in {cameras} and are skipped")
    if blurred:
        say(f"{blurred} images have a blur score below {min_blur_score:g} and are skipped (--min-blur-score)")
    if not found:
        raise DataError(f"{images.parent} has no usable image; lower --min-blur-score, or export again")
    return Capture(PROGRAM, evenly_spaced(found, max_images), Counter(), z_is_up=True, frame=Z_UP)


def place(parts: tuple[str, ...]) -> tuple[str, ...] | None:
    """Return where a file of a zip file belongs in the folder of an export; None for files that are not needed.

    `parts` belong to its path in the zip file; the folder keyframes may be inside another one.
    """
    inside = parts[parts.index("keyframes") :] if "keyframes" in parts else ()
    return inside if len(inside) == 3 and inside[1] in FOLDERS and parts[0] != "__MACOSX" else None


def blur_score_of(camera: dict[str, Any], path: Path, unknown: float) -> float:
    """Return the sharpness of an image by Polycam from the content `camera` of `path`, or `unknown` without.

    Raises:
        DataError: if the score is not a number.
    """
    try:
        return finite(camera.get("blur_score", unknown))
    except UNUSABLE as error:
        raise DataError(f"{path}: the blur_score is not a number") from error


def pose_of(camera: dict[str, Any], path: Path) -> np.ndarray:
    """Return camera-to-world (4, 4), OpenGL axes, y up, from the content `camera` of the JSON file `path`.

    Raises:
        DataError: if the pose is incomplete.
    """
    try:
        rows = [[finite(camera[f"t_{row}{column}"]) for column in range(4)] for row in range(3)]
    except UNUSABLE as error:
        raise DataError(f"{path} has no complete pose (t_00 to t_23)") from error
    return np.array([*rows, [0.0, 0.0, 0.0, 1.0]])


def lens_of(camera: dict[str, Any], path: Path) -> Lens:
    """Return the lens that the content `camera` of the JSON file `path` describes.

    Raises:
        DataError: if the lens is incomplete.
    """
    try:
        size = (camera["width"], camera["height"])
        return undistorted_lens(size, [camera[name] for name in ("fx", "fy", "cx", "cy")])
    except UNUSABLE as error:
        raise DataError(f"{path} has no complete lens (width, height, fx, fy, cx, cy)") from error


def folders_of(export: Path) -> tuple[Path, Path]:
    """Return the folders of images and cameras of a raw `export`; those corrected by Polycam if they exist.

    Raises:
        DataError: if it is no raw export.
    """
    for root in (export / "keyframes", export):
        for prefix in ("corrected_", ""):
            images, cameras = root / f"{prefix}images", root / f"{prefix}cameras"
            if images.is_dir() and cameras.is_dir():
                return images, cameras
    raise DataError(f"--data {export} is not a raw export of Polycam: it has no keyframes/images and keyframes/cameras")
