"""Validation of values read from untrusted files; errors name the file and the entry in one line."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from nerfloom import DataError
from nerfloom.base.errors import shown
from nerfloom.base.json_files import number
from nerfloom.cameras.cameras import MAX_SIDE, check_pose
from nerfloom.dataparsers.rotations import nearest_rotation

MAX_NAME_LENGTH = 250
"""Maximum length of a file's or folder's name, bytes; most systems allow 255."""
MAX_PATH_LENGTH = 3000
"""Maximum length of a path, bytes; most systems allow 4096."""


Frames = list[tuple[dict[str, Any], str]]
"""The JSON object of each frame, and its name in messages."""


def read_frames(content: dict[str, Any], file: Path, image: str) -> Frames:
    """Return the frames that `content` of `file` lists; each names its image by the entry `image`.

    Raises:
        DataError: if no frames are listed, or one is not an object.
    """
    frames = content.get("frames")
    if not isinstance(frames, list) or not frames:
        raise DataError(f"{file} lists no frames; 'frames' must be a list of images and their poses")
    named = [(frame, f"{file}: frame {index}") for index, frame in enumerate(frames)]
    for frame, label in named:
        if not isinstance(frame, dict):
            raise DataError(f"{label} is {shown(frame)}; it must be an object with '{image}'")
    return named


def read_pose(frame: dict[str, Any], where: str) -> Tensor:
    """Return the camera-to-world matrix (4, 4) float64 of a JSON object `frame`, called `where` in messages.

    Raises:
        DataError: if the matrix is missing, of another shape, not finite or not rigid.
    """
    return rigid(frame.get("transform_matrix"), f"{where}: 'transform_matrix'", where)


def rigid(matrix: Any, name: str, where: str) -> Tensor:
    """Return a rigid motion (4, 4) float64 from three or four rows of four numbers; its rotation may be rounded.

    Args:
        matrix: the rows.
        name: name of the matrix, for the message if it has another shape.
        where: name of the pose, for the message if it is invalid.

    Raises:
        DataError: if the matrix is of another shape, not finite or not rigid.
    """
    try:
        pose = torch.tensor(matrix, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise DataError(f"{name} is not a 4x4 matrix of numbers") from error
    if pose.shape in ((3, 4), (4, 4)):
        pose[:3, :3] = nearest_rotation(pose[:3, :3])
    check_pose(pose, where)
    return pose if pose.shape[0] == 4 else torch.cat([pose, pose.new_tensor([[0.0, 0.0, 0.0, 1.0]])])


def read_times(frames: Frames) -> Tensor | None:
    """Return the times (M,) in [0, 1] of `frames`; None if no frame has one.

    Raises:
        DataError: if only some frames have a time, or one is not a number from 0 to 1.
    """
    if not any("time" in frame for frame, _ in frames):
        return None
    for frame, label in frames:
        time = frame.get("time")
        if not isinstance(time, (int, float)) or isinstance(time, bool) or not 0 <= time <= 1:
            raise DataError(f"{label}: 'time' is {shown(time)}; it must be a number from 0 to 1")
    return torch.tensor([float(frame["time"]) for frame, _ in frames])


def side(value: Any, name: str, where: str) -> int:
    """Return the width or height of an image, in whole pixels.

    `value`, `name` and `where` are as in `number`.

    Raises:
        DataError: if the value is not a number, or not a possible size of an image.
    """
    length = number(value, name, where, positive=True)
    if not 1 <= length <= MAX_SIDE:
        raise DataError(f"{where}: '{name}' is {shown(value)}; it must be from 1 to {MAX_SIDE} pixels")
    return round(length)


def side_or_none(value: Any, name: str, where: str) -> int | None:
    """Return `side` of an entry, or None if it is missing.

    `value`, `name` and `where` are as in `number`.

    Raises:
        DataError: see `side`.
    """
    return None if value is None else side(value, name, where)


def numbers(value: Any, count: int, name: str, where: str) -> list[float]:
    """Return a list of `count` finite numbers.

    `value`, `name` and `where` are as in `number`.

    Raises:
        DataError: if the value is not such a list.
    """
    if not isinstance(value, list) or len(value) != count:
        raise DataError(f"{where}: '{name}' is {shown(value)}; it must be a list of {count} numbers")
    return [number(part, name, where) for part in value]


def file_name(value: Any, name: str, where: str) -> str:
    """Return the name of a file given by a JSON entry.

    `value`, `name` and `where` are as in `number`.

    Raises:
        DataError: if the value is missing, not text, or not a possible name of a file.
    """
    if not isinstance(value, str) or not value:
        raise DataError(f"{where}: '{name}' is missing")
    path = Path(value)
    if not path.name or "\0" in value or not _fits(path):
        raise DataError(f"{where}: '{name}' is not the name of a file")
    return value


def _fits(path: Path) -> bool:
    """Return whether the path may be passed to the system, whether the file exists or not."""
    try:
        longest = max(len(os.fsencode(part)) for part in path.parts)
        return longest <= MAX_NAME_LENGTH and len(os.fsencode(path)) <= MAX_PATH_LENGTH
    except UnicodeEncodeError:  # a lone surrogate
        return False
