"""Record3D's exports: folders "EXR + RGBD" with EXR_RGBD/rgb/N.jpg and metadata.json, and recordings, RECORDING.r3d.

A recording is a zip file with rgbd/N.jpg and metadata, which holds the same JSON. Its depth images are compressed by
LZFSE, and are not read.

Poses are in the axes of the images as they are stored, portrait or landscape. The world's frame is the first camera's,
and its inclination is not recorded (the app's author, github.com/marek-simonik/record3d, issue 27).
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
from nerfloom.processing.finite_numbers import UNUSABLE
from nerfloom.processing.listing import evenly_spaced, find_images
from nerfloom.processing.polycam import Z_UP
from nerfloom.processing.transforms import Lens

PROGRAM = "Record3D"
"""Name for messages."""


def read_capture(root: Path, max_images: int) -> Capture:
    """Read the cameras of an export; the name of a camera is the path of its image in the folder rgb.

    An image's number is the index of its pose in metadata.json; images may be missing.

    Args:
        root: folder of the export, from `find_root`.
        max_images: maximum number of images, evenly spaced.

    Raises:
        DataError: if the metadata are invalid, or no image is usable.
    """
    path = root / "metadata.json"
    metadata = read_object(path)
    poses = poses_of(metadata, path)
    images = find_images(root / "rgb")
    numbered = {int(name.stem): name for name in images if name.stem.isdecimal()}
    if len(numbered) < len(images):
        say(f"{len(images) - len(numbered)} images in {root / 'rgb'} have no number of their own and are skipped")
    usable = [number for number in sorted(numbered) if number < len(poses)]
    if len(usable) < len(numbered):
        say(f"{len(numbered) - len(usable)} images have a number beyond the {len(poses)} poses and are skipped")
    if not usable:
        raise DataError(f"{root / 'rgb'} has no image with the number of a pose in {path}")
    if len(usable) < len(poses):
        say(f"{len(poses) - len(usable)} of {len(poses)} poses have no image")
    lenses = lenses_of(metadata, len(poses), path)
    cameras = [
        PosedCamera(numbered[number].as_posix(), poses[number], for_size_of(lenses[number]))
        for number in evenly_spaced(usable, max_images)
    ]
    return Capture(PROGRAM, cameras, Counter(), frame=Z_UP)  # y is up in the image of the first camera


def place(parts: tuple[str, ...]) -> tuple[str, ...] | None:
    """Return where a recording's file, at `parts` in the zip file, belongs in an export; None if it is not needed."""
    if parts == ("metadata",):
        return ("metadata.json",)
    if len(parts) == 2 and parts[0] == "rgbd" and parts[1].lower().endswith((".jpg", ".jpeg", ".png")):
        return ("rgb", parts[1])
    return None


def place_points(parts: tuple[str, ...]) -> tuple[str, ...] | None:
    """Return the name for a PLY file, at `parts` in a zip file of points; None for other files.

    The points of all frames are in the frame of the poses, as nerfstudio's reader takes them.
    """
    name = parts[-1]
    return (name,) if name.lower().endswith(".ply") and not name.startswith(".") else None


def find_root(export: Path) -> Path:
    """Return the folder with rgb and metadata.json: `export` or one in it.

    Raises:
        DataError: if there is no such folder.
    """
    for root in (export / "EXR_RGBD", export):
        if (root / "rgb").is_dir() and (root / "metadata.json").is_file():
            return root
    raise DataError(
        f"--data {export} is not an export of Record3D: it has no EXR_RGBD with rgb and metadata.json; "
        "export with 'EXR + RGBD'"
    )


def poses_of(metadata: dict[str, Any], path: Path) -> np.ndarray:
    """Return the camera-to-world matrices (N, 4, 4), OpenGL axes, from entries [qx, qy, qz, qw, tx, ty, tz].

    Args:
        metadata: content of metadata.json.
        path: the file, for messages.

    Raises:
        DataError: if the entries are invalid.
    """
    try:
        rows = np.array(metadata["poses"], np.float64).reshape(-1, 7)
    except UNUSABLE as error:
        raise DataError(f"{path} has no poses of 7 numbers each") from error
    with np.errstate(over="ignore"):
        lengths = np.linalg.norm(rows[:, :4], axis=1, keepdims=True)
    if not len(rows) or not np.isfinite(rows).all() or not (np.isfinite(lengths) & (lengths > 0)).all():
        raise DataError(f"{path} has no poses, or poses that are not finite or have no rotation")
    if len(rows) > 1 and (rows == rows[0]).all():
        raise DataError(f"{path}: all {len(rows)} poses are equal; Record3D records them with the rear camera only")
    rows[:, :4] /= lengths
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = rotations(rows[:, :4])
    poses[:, :3, 3] = rows[:, 4:]
    return poses


def rotations(quaternions: np.ndarray) -> np.ndarray:
    """Return the rotation matrices (N, 3, 3) of unit `quaternions` (N, 4), real part last."""
    x, y, z, w = quaternions.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows).transpose(2, 0, 1)


def lenses_of(metadata: dict[str, Any], count: int, path: Path) -> list[Lens]:
    """Return the lens of each pose: its own if the export has one for each, otherwise the whole capture's (K).

    Args:
        metadata: content of metadata.json; K is stored column by column.
        count: number of poses N.
        path: the file, for messages.

    Raises:
        DataError: if the intrinsics are incomplete.
    """
    try:
        size = (metadata["w"], metadata["h"])
        own = metadata.get("perFrameIntrinsicCoeffs") or []
        if len(own) == count:
            each = [tuple(row[:4]) for row in own]
        else:
            matrix = np.array(metadata["K"], np.float64).reshape(3, 3).T
            each = [(matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])] * count
        return [undistorted_lens(size, intrinsics) for intrinsics in each]
    except UNUSABLE as error:
        raise DataError(f"{path} has no complete lens (w, h, K of 9 numbers)") from error
