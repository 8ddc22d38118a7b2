"""A COLMAP reconstruction: which one of a folder's, and its cameras, poses and sparse points.

Schönberger and Frahm 2016.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from dataparsers.colmap_files import check_binary, count_images
from dataparsers.reading import file_name
from framework import DataError
from framework.base.console import say
from framework.cameras.cameras import check_pose
from framework.data.dataset import one_line

PLACES = ("sparse", "colmap/sparse")
"""Where reconstructions are looked for, each there itself or in a folder of its own below."""
FILES = ("cameras", "images", "points3D")
SHORTEST_TRACK = 3
"""Images that must have seen a sparse point; two can agree on a wrong one."""
LARGEST_ERROR = 2.0
"""Pixels that a sparse point may be off by, on average."""


@dataclass(frozen=True)
class SparseCamera:
    """A camera as COLMAP has it."""

    model: str
    """COLMAP's name of the projection."""
    params: tuple[float, ...]
    """In COLMAP's order."""
    width: int
    """Of the photographs it was fitted to, pixels."""
    height: int


@dataclass(frozen=True)
class SparseModel:
    """M registered images, by sorted name."""

    names: tuple[str, ...]
    """M paths below the folder of images."""
    poses: Tensor
    """(M, 4, 4) float64 camera-to-world, OpenGL axes."""
    cameras: tuple[SparseCamera, ...]
    """The camera of each image."""
    points: Tensor
    """(K, 3) float64 sparse points that several images agree on."""


def find_models(path: Path, places: tuple[str, ...] = PLACES) -> list[Path]:
    """The reconstructions of the first of some places that has any, by name. Never raises."""
    for place in places:
        try:
            folders = [path / place, *sorted(path.joinpath(place).iterdir())]
            kinds = ("bin", "txt")
            models = [folder for folder in folders if any((folder / f"images.{kind}").is_file() for kind in kinds)]
        except OSError:
            continue
        if models:
            return models
    return []


def choose_model(path: Path, place: str | None, flag: str = "--colmap-path") -> Path:
    """The reconstruction to read: of several the one with the most images, which is said.

    Args:
        path: the data folder.
        place: where to look below it, or None for the usual places.
        flag: what sets `place`, for messages.
    Raises: DataError where there is none.
    """
    places = PLACES if place is None else (place,)
    models = find_models(path, places)
    if not models:
        raise DataError(
            f"{path} has no COLMAP reconstruction: no images.bin or images.txt in {', '.join(places)} or a folder "
            f"below; run COLMAP, or name its folder with {flag}"
        )
    counts = [count_images(model) for model in models]
    best = counts.index(max(counts))
    if len(models) > 1:
        say(
            f"{len(models)} COLMAP reconstructions: {models[best]} has the most images "
            f"({counts[best]}) and is used ({flag} chooses another)"
        )
    return models[best]


def read_model(folder: Path) -> SparseModel:
    """Read a reconstruction, binary or text, through pycolmap.

    Raises: DataError where a file is missing, damaged or contradicts another, where no image has a pose, or where
        pycolmap is not installed.
    """
    if not any(all((folder / f"{name}.{kind}").is_file() for name in FILES) for kind in ("bin", "txt")):
        raise DataError(f"{folder} is not a whole COLMAP model: it needs {', '.join(FILES)}, all .bin or all .txt")
    check_binary(folder)
    try:
        import pycolmap
    except ImportError as error:
        raise DataError(f"reading {folder} needs pycolmap, which is not there: pip install pycolmap") from error
    try:
        model = pycolmap.Reconstruction(str(folder))
        images = sorted((model.images[number] for number in model.reg_image_ids()), key=lambda image: image.name)
        names = tuple(image.name for image in images)
        poses = [_camera_to_world(image) for image in images]
        cameras = tuple(_camera(model.cameras[image.camera_id]) for image in images)
        points = _points(model)
    except Exception as error:  # pycolmap raises IndexError, ValueError, RuntimeError, UnicodeDecodeError and more
        raise DataError(f"{folder} cannot be read: its files are damaged or do not fit ({one_line(error)})") from error
    if not images:
        raise DataError(f"{folder} has no image with a pose; COLMAP did not succeed in registering any")
    for name, pose in zip(names, poses, strict=True):
        _check(name, pose, folder)
    return SparseModel(names, torch.stack(poses), cameras, points)


def _camera_to_world(image: Any) -> Tensor:
    """(4, 4) float64, OpenGL axes, from the inverse with OpenCV's (y down, looking along +z)."""
    pose = image.cam_from_world
    pose = pose() if callable(pose) else pose  # a property before pycolmap 3.12, a method since
    world_to_camera = torch.from_numpy(pose.matrix()).double()
    rotation = world_to_camera[:, :3].T
    result = torch.eye(4, dtype=torch.float64)
    result[:3, :3] = rotation * torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
    result[:3, 3] = -(rotation @ world_to_camera[:, 3])
    return result


def _camera(camera: Any) -> SparseCamera:
    return SparseCamera(camera.model.name, tuple(float(p) for p in camera.params), camera.width, camera.height)


def _points(model: Any) -> Tensor:
    """(K, 3) float64 points that enough images agree on."""
    found = [
        torch.from_numpy(point.xyz)
        for point in model.points3D.values()
        # The error is -1 where nobody computed it.
        if point.track.length() >= SHORTEST_TRACK and point.error <= LARGEST_ERROR
    ]
    points = torch.stack(found) if found else torch.zeros(0, 3, dtype=torch.float64)
    return points[torch.isfinite(points).all(-1)]


def _check(name: str, pose: Tensor, folder: Path) -> None:
    where = f"{folder}: image {name!r}"
    file_name(name, "name", where)
    check_pose(pose, where)
