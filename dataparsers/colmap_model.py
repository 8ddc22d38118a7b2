"""COLMAP reconstructions: choice of one, and its cameras, poses and sparse points.

Schönberger and Frahm 2016.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nerfloom import DataError
from nerfloom.base.console import say
from nerfloom.base.errors import one_line
from nerfloom.cameras.cameras import check_pose
from nerfloom.data.names_on_disk import match_names
from nerfloom.dataparsers.colmap_files import check_binary, check_text, image_names, text_names
from nerfloom.dataparsers.reading import file_name
from nerfloom.dataparsers.rotations import rotations, unit_quaternions

LOCATIONS = ("sparse", "colmap/sparse", ".")
"""Folders searched for reconstructions, at any depth up to `MAX_DEPTH`; the data folder itself comes last."""
MAX_DEPTH = 4
"""Maximum number of levels below these folders, such as sparse/0/models/1."""
FILES = ("cameras", "images", "points3D")
"""Files of a reconstruction, without suffix."""
MIN_ERROR = 0.5
"""Minimum reprojection error assumed for a point, pixels; also used if no error was computed."""


@dataclass(frozen=True)
class SparseCamera:
    """A camera in COLMAP's terms."""

    model: str
    """COLMAP's name of the projection."""
    params: tuple[float, ...]
    """Parameters in COLMAP's order."""
    width: int
    """Width of the images, pixels."""
    height: int
    """Height of the images, pixels."""


@dataclass(frozen=True)
class SparseModel:
    """A reconstruction of M registered images, sorted by name."""

    names: tuple[str, ...]
    """M paths relative to the images' folder."""
    poses: Tensor
    """(M, 4, 4) float64 camera-to-world, OpenGL axes."""
    cameras: tuple[SparseCamera, ...]
    """The camera of each image."""
    points: Tensor
    """(K, 3) float64 sparse points, all that are finite."""
    errors: Tensor
    """(K,) float64 mean reprojection error of each point, pixels, at least `MIN_ERROR`."""
    lengths: Tensor
    """(K,) int64 length of each point's track, including sightings in images without a pose."""
    sightings: Tensor
    """(O, 2) int64 image and the point seen in it."""


def find_models(path: Path, locations: Sequence[str] = LOCATIONS) -> list[Path]:
    """Return the reconstructions in subfolders `locations` of `path` and below them, in order. Never raises."""
    models: list[Path] = []
    for location in locations:
        levels = 0 if location == "." else MAX_DEPTH
        models += [folder for folder in _folders(path / location, levels) if _is_model(folder)]
    return list(dict.fromkeys(models))


def _folders(folder: Path, levels: int) -> list[Path]:
    """Return a folder and its subfolders down to a number of levels, sorted by name."""
    try:
        inside = sorted(entry for entry in folder.iterdir() if entry.is_dir()) if levels else []
    except OSError:
        return [folder]
    return [folder, *(deeper for entry in inside for deeper in _folders(entry, levels - 1))]


def _is_model(folder: Path) -> bool:
    try:
        return any((folder / f"images.{kind}").is_file() for kind in ("bin", "txt"))
    except OSError:
        return False


def choose_model(path: Path, location: str | None, images: str = "images", quiet: bool = False) -> Path:
    """Return the reconstruction with the most existing images; if there are several, report the others.

    Args:
        path: the data folder.
        location: subfolder to search; None for the default ones.
        images: folder of the images in `path`.
        quiet: whether to report nothing.

    Raises:
        DataError: if there is no reconstruction.
    """
    locations = LOCATIONS if location is None else (location,)
    models = find_models(path, locations)
    if not models:
        raise DataError(
            f"{path} has no COLMAP reconstruction: no images.bin or images.txt in {', '.join(locations)} or a folder "
            f"below; run COLMAP, or set its folder with --colmap-path"
        )
    if len(models) == 1:
        return models[0]
    names = [image_names(model) for model in models]
    there = [len(match_names(path, [f"{images}/{name}" for name in some]).files) for some in names]
    best = max(range(len(models)), key=lambda index: (there[index], len(names[index]), -index))
    if not quiet:
        shown = [model.relative_to(path).as_posix() for model in models]
        others = ", ".join(f"{shown[index]} has {there[index]}" for index in range(len(models)) if index != best)
        say(
            f"{len(models)} COLMAP reconstructions in {path}: using {shown[best]} with {there[best]} of the existing "
            f"images; {others} (--colmap-path chooses another)"
        )
    return models[best]


def read_model(folder: Path) -> SparseModel:
    """Read a reconstruction in `folder`, binary or text, with pycolmap.

    Raises:
        DataError: if a file is missing, damaged or contradicts another, no image has a pose, or pycolmap is not
            installed.
    """
    complete = {kind: all((folder / f"{name}.{kind}").is_file() for name in FILES) for kind in ("bin", "txt")}
    if not any(complete.values()):
        raise DataError(
            f"{folder} is not a complete COLMAP model: it needs {', '.join(FILES)}, all .bin or all .txt; export it "
            "again, or, if a text model has no points, add an empty points3D.txt"
        )
    check_binary(folder)
    try:
        import pycolmap
    except ImportError as error:
        raise DataError(f"reading {folder} needs pycolmap, which is not installed: pip install pycolmap") from error
    try:
        if not complete["bin"]:
            check_text(folder)
        # In text files, pycolmap ends a name at its first space.
        known = {} if complete["bin"] else text_names(folder / "images.txt")
        model = pycolmap.Reconstruction(str(folder))
        named = {number: known.get(number) or model.images[number].name for number in model.reg_image_ids()}
        images = [model.images[number] for number in sorted(named, key=lambda number: (named[number], number))]
        names = tuple(named[image.image_id] for image in images)
        poses = _camera_to_worlds(images, names, folder)
        cameras = tuple(_camera(model.cameras[image.camera_id]) for image in images)
        points, errors, lengths, sightings = _points(model, [image.image_id for image in images])
    except DataError:
        raise
    except Exception as error:  # pycolmap raises IndexError, ValueError, RuntimeError, UnicodeDecodeError and more
        raise DataError(
            f"{folder} cannot be read: its files are damaged or inconsistent ({one_line(error)})"
        ) from error
    if not images:
        raise DataError(
            f"{folder} has no image with a pose, as COLMAP registered none; take more photographs that overlap, or "
            "name another model: --colmap-path FOLDER"
        )
    for name, pose in zip(names, poses, strict=True):
        _check(name, pose, folder)
    if left_out := len(model.points3D) - len(points):
        say(f"{folder}: {left_out:,} of {len(model.points3D):,} sparse points are not finite and left out")
    return SparseModel(names, poses, cameras, points, errors, lengths, sightings)


def _camera_to_worlds(images: Sequence[Any], names: Sequence[str], folder: Path) -> Tensor:
    """Return camera-to-world matrices (M, 4, 4) float64, OpenGL axes; COLMAP stores the inverse with OpenCV's axes."""
    stored = [image.cam_from_world for image in images]
    stored = [pose() if callable(pose) else pose for pose in stored]  # a property before pycolmap 3.12, then a method
    quaternions = torch.tensor(np.array([pose.rotation.quat for pose in stored]), dtype=torch.float64).view(-1, 4)
    translations = torch.tensor(np.array([pose.translation for pose in stored]), dtype=torch.float64).view(-1, 3)
    # A quaternion of length 0 would count as no rotation.
    unit = unit_quaternions(quaternions, [f"{folder}: image {name!r}" for name in names])
    rotation = rotations(unit).transpose(1, 2)
    result = torch.eye(4, dtype=torch.float64).repeat(len(images), 1, 1)
    result[:, :3, :3] = rotation * torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
    result[:, :3, 3] = -(rotation @ translations[..., None])[..., 0]
    return result


def _camera(camera: Any) -> SparseCamera:
    return SparseCamera(camera.model.name, tuple(float(p) for p in camera.params), camera.width, camera.height)


def _points(model: Any, numbers: Sequence[int]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the finite sparse points, their errors, the lengths of their tracks, and the images that see them.

    Args:
        model: the reconstruction.
        numbers: COLMAP's numbers of the images; sightings in other images, which have no pose, are left out.
    """
    rows = {number: row for row, number in enumerate(numbers)}
    positions: list[np.ndarray] = []
    errors: list[float] = []
    lengths: list[int] = []
    sightings: list[tuple[int, int]] = []
    for point in model.points3D.values():
        if not np.isfinite(point.xyz).all():
            continue
        # A track may contain an image twice.
        images = {rows[number] for number in (sighting.image_id for sighting in point.track.elements) if number in rows}
        sightings += [(image, len(positions)) for image in sorted(images)]
        positions.append(point.xyz)
        errors.append(max(float(point.error), MIN_ERROR))  # the error is -1 if it was not computed
        lengths.append(point.track.length())
    points = torch.from_numpy(np.stack(positions)) if positions else torch.zeros(0, 3, dtype=torch.float64)
    seen = torch.tensor(sightings, dtype=torch.int64).view(-1, 2)
    return points, torch.tensor(errors, dtype=torch.float64), torch.tensor(lengths, dtype=torch.int64), seen


def _check(name: str, pose: Tensor, folder: Path) -> None:
    where = f"{folder}: image {name!r}"
    file_name(name, "name", where)
    check_pose(pose, where)
