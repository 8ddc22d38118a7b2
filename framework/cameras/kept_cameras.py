"""Cameras of a capture, kept beside a file of its Gaussians: from where it was photographed, and which way is up.

A file NAME has them in NAME.cameras.json, a camera path (`camera_path`) in a scene with +z up, with the placement of
the file's input in that scene. `ns-render camera-path` takes it, too.
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from nerfloom.base.errors import DataError
from nerfloom.base.evenly_spaced import strided
from nerfloom.cameras.camera_path import CameraPath, read_camera_path, write_camera_path
from nerfloom.cameras.poses import Placement

SUFFIX = ".cameras.json"
"""Suffix of the file of cameras, appended to the name of their file."""
MOST = 100
"""Maximum number of cameras that are kept, evenly spaced."""
SIDE, OPENING = 800, 50.0
"""Width and height, pixels, and field of view, degrees, of the kept cameras: their lenses are not kept."""


def cameras_file(file: Path) -> Path:
    """Return the path of the cameras of a `file`."""
    return file.with_name(file.name + SUFFIX)


def kept_cameras(poses: Tensor, placement: Placement) -> CameraPath:
    """Return cameras to keep beside a file.

    Args:
        poses: (M, 3, 4) camera-to-scene, OpenGL axes, in a scene with +z up.
        placement: placement of the file's input in that scene.
    """
    chosen = poses.double().cpu()[strided(len(poses), MOST)]
    fovs = torch.full((len(chosen),), OPENING, dtype=torch.float64)
    return CameraPath("perspective", SIDE, SIDE, chosen, fovs, seconds=float(len(chosen)), placement=placement)


def write_cameras(file: Path, cameras: CameraPath | None) -> None:
    """Write the `cameras` of a `file` beside it; with None, remove those of an earlier file of the same name.

    Raises:
        OSError: if they cannot be written or removed.
    """
    if cameras is None:
        cameras_file(file).unlink(missing_ok=True)
    else:
        write_camera_path(cameras_file(file), cameras)


def read_cameras(file: Path) -> CameraPath | None:
    """Read the cameras that are kept beside a `file`; None if there are none.

    Raises:
        DataError: if they cannot be read, or have no placement.
    """
    beside = cameras_file(file)
    if not beside.exists():
        return None
    cameras = read_camera_path(beside)
    if cameras.placement is None:
        raise DataError(f"{beside} has no 'placement', so that its cameras are nowhere: remove it, or export again")
    return cameras
