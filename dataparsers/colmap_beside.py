"""The COLMAP model that a transforms.json beside it was made from: it tells which images see which points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from nerfloom import DataError
from nerfloom.base.console import say
from nerfloom.data.names_on_disk import spelled
from nerfloom.data.tracks import Tracks
from nerfloom.dataparsers.colmap import tracks_of
from nerfloom.dataparsers.colmap_lens import lenses_of
from nerfloom.dataparsers.colmap_model import choose_model, find_models, read_model

MAX_ANGLE = 0.2
"""Maximum angle between an image's rotations in the model and in the file, degrees: about two pixels of a phone's image
at 800 pixels."""
MAX_SHIFT = 0.002
"""Maximum distance between its positions, relative to the largest distance of a camera from the cameras' mean."""
MIN_ALIKE = 0.5
"""Minimum fraction of common images with the same pose; with fewer, the file was not made from the model."""


def tracks_beside(
    folder: Path, names: Sequence[Sequence[str]], poses: Tensor, applied: Tensor, scale: float
) -> Tracks | None:
    """Return the tracks of the model beside a transforms.json, in the file's frame and for its images.

    A model that cannot be read, or has other poses than the file, is not used, and this is reported. Images with
    another pose are left out.

    Args:
        folder: the data folder.
        names: for each of the file's M images, its possible paths in the model.
        poses: (M, 3 or 4, 4) camera-to-world of the file.
        applied: (4, 4) rotation and translation from the model's frame to the file's.
        scale: factor of positions, applied last.

    Returns:
        The tracks; None if there is no matching model.
    """
    if not find_models(folder):
        return None
    try:
        path = choose_model(folder, None)
        model = read_model(path)
        tracks = tracks_of(model, lenses_of(model.cameras, model.names, str(path)).intrinsics)
    except DataError as error:
        say(f"{error}; continuing without the distances of its points")
        return None
    if tracks is None:
        return None
    places = {spelled(name): place for place, name in enumerate(model.names)}
    pairs = [
        (image, next(places[name] for name in known if name in places))
        for image, known in enumerate(names)
        if any(name in places for name in known)
    ]
    ours, theirs = torch.tensor(pairs, dtype=torch.int64).view(-1, 2).unbind(-1)
    alike = _same_poses(poses[ours].double(), _moved(model.poses[theirs], applied.double(), scale))
    if int(alike.sum()) < max(MIN_ALIKE * len(pairs), 1):
        say(
            f"{path}: only {int(alike.sum())} of {len(poses)} images have their pose from transforms.json, so it "
            "is another reconstruction; continuing without the distances of its points"
        )
        return None
    number = torch.full((len(model.names),), -1, dtype=torch.int64)
    number[theirs[alike]] = ours[alike]
    kept = number[tracks.images] >= 0
    points = scale * (tracks.points @ applied[:3, :3].T.double() + applied[:3, 3].double())
    return replace(
        tracks, points=points, images=number[tracks.images[kept]], seen=tracks.seen[kept], angles=tracks.angles[kept]
    )


def names_in_model(file_path: str, source_path: object) -> list[str]:
    """Return the possible paths of a frame's image in a model, in comparable form, most likely first.

    Args:
        file_path: the frame's image, such as 'images/a/1.jpg', where a model has 'a/1.jpg'.
        source_path: the file that the image was made from; ignored if it is not text.
    """
    parts = spelled(file_path).split("/")
    endings = ["/".join(parts[start:]) for start in range(len(parts))]
    return [*endings, spelled(source_path)] if isinstance(source_path, str) else endings


def _moved(poses: Tensor, applied: Tensor, scale: float) -> Tensor:
    """Return poses (M, 4, 4) in the file's frame."""
    moved = applied @ poses
    moved[:, :3, 3] *= scale
    return moved


def _same_poses(ours: Tensor, theirs: Tensor) -> Tensor:
    """Return which of M poses agree within `MAX_ANGLE` and `MAX_SHIFT`, (M,) bool."""
    centers = ours[:, :3, 3]
    spread = (centers - centers.mean(0)).norm(dim=-1).max() if len(ours) else 0.0
    apart = (ours[:, :3, :3] - theirs[:, :3, :3]).flatten(1).norm(dim=-1) / 8**0.5  # the sine of half the angle
    turned = torch.rad2deg(2 * torch.asin(apart.clamp(max=1)))
    return (turned <= MAX_ANGLE) & ((centers - theirs[:, :3, 3]).norm(dim=-1) <= MAX_SHIFT * spread)
