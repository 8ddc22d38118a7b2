"""Values out of files that nobody has checked: refused in one line that says which file and which entry."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from framework import DataError
from framework.base.errors import shown as shown
from framework.cameras.cameras import LARGEST_SIDE, check_pose

LONGEST_NAME, LONGEST_PATH = 250, 3000
"""Bytes of a file's or folder's name, and of all on the way to a file; most systems allow 255, and 4096 in all."""


def read_json(file: Path) -> dict[str, Any]:
    """A JSON file that holds an object.

    Raises: DataError where it is missing, not JSON, or something else.
    """
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise DataError(f"cannot read {file}: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise DataError(f"{file} is not JSON: {error}") from error
    if not isinstance(content, dict):
        raise DataError(f"{file} must hold a JSON object: names and values between braces")
    return content


def read_pose(frame: Any, where: str, dtype: torch.dtype = torch.float32) -> Tensor:
    """The frame's (4, 4) camera-to-world matrix, checked.

    Raises: DataError where it is absent, of another shape, not finite or not rigid.
    """
    matrix = frame.get("transform_matrix") if isinstance(frame, dict) else None
    return rigid(matrix, f"{where}: 'transform_matrix'", where, dtype)


def rigid(matrix: Any, name: str, where: str, dtype: torch.dtype = torch.float64) -> Tensor:
    """A (4, 4) rigid motion from three or four rows of four numbers.

    Args:
        name: what to call the matrix where it is none.
        where: what to call it where it is a wrong one.
    Raises: DataError where it is of another shape, not finite or not rigid.
    """
    try:
        pose = torch.tensor(matrix, dtype=dtype)
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise DataError(f"{name} is not a 4x4 matrix of numbers") from error
    check_pose(pose, where)
    return pose if pose.shape[0] == 4 else torch.cat([pose, torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=dtype)])


def read_times(frames: list[Any], where: list[str]) -> Tensor | None:
    """(M,) times in [0, 1], or None where no frame has a time.

    Raises: DataError where only some have one, or it is no number from 0 to 1.
    """
    if not any("time" in frame for frame in frames):
        return None
    for frame, place in zip(frames, where, strict=True):
        time = frame.get("time")
        if not isinstance(time, (int, float)) or isinstance(time, bool) or not 0 <= time <= 1:
            raise DataError(f"{place}: 'time' is {shown(time)}; it must be a number from 0 to 1")
    return torch.tensor([float(frame["time"]) for frame in frames])


def number(value: Any, name: str, where: str, positive: bool = False) -> float:
    """A finite number, and where `positive` one above zero.

    Args:
        value: what the file has there, None where it has nothing.
        name, where: what to call the entry, and the file with the frame, in the message.
    Raises: DataError where it is anything else.
    """
    wanted = "a number above zero" if positive else "a number"
    real = isinstance(value, (int, float)) and not isinstance(value, bool)
    try:
        result = float(value) if real else math.nan
    except OverflowError:
        result = math.inf
    if not math.isfinite(result) or (positive and result <= 0):
        raise DataError(f"{where}: '{name}' is {shown(value)}; it must be {wanted}")
    return result


def side(value: Any, name: str, where: str) -> int:
    """An image's width or height in whole pixels.

    Raises: DataError where it is no number, or none that an image can have.
    """
    length = number(value, name, where, positive=True)
    if not 1 <= length <= LARGEST_SIDE:
        raise DataError(f"{where}: '{name}' is {shown(value)}; no image has such a side")
    return round(length)


def numbers(value: Any, count: int, name: str, where: str) -> list[float]:
    """A list of that many finite numbers.

    Raises: DataError where it is anything else.
    """
    if not isinstance(value, list) or len(value) != count:
        raise DataError(f"{where}: '{name}' is {shown(value)}; it must be a list of {count} numbers")
    return [number(part, name, where) for part in value]


def file_name(value: Any, name: str, where: str) -> str:
    """The name of a file as a JSON entry gives it.

    Raises: DataError where it is absent, no text, or a name that no file can have.
    """
    if not isinstance(value, str) or not value:
        raise DataError(f"{where}: '{name}' is missing")
    path = Path(value)
    if not path.name or "\0" in value or not _fits(path):
        raise DataError(f"{where}: '{name}' is not the name of a file")
    return value


def _fits(path: Path) -> bool:
    """Whether a file may be asked for by such a path, be it there or not."""
    try:
        longest = max(len(os.fsencode(part)) for part in path.parts)
        return longest <= LONGEST_NAME and len(os.fsencode(path)) <= LONGEST_PATH
    except UnicodeEncodeError:  # half of a character
        return False
