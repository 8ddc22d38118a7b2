"""Offsets of files that store coordinates relative to a local origin, because float32 is too coarse for the input's.

A file NAME of this kind has a file NAME.offset.json beside it, with `offset`, three numbers. A position in the file
plus the offset is the position in the input's frame. A file without an offset is in the input's frame.
"""

from __future__ import annotations

import json
import math
from pathlib import Path

import torch
from torch import Tensor

from nerfloom.base.atomic import write_atomically
from nerfloom.base.errors import DataError, shown
from nerfloom.base.json_files import read_json

SUFFIX = ".offset.json"
"""Suffix of an offset file, appended to the name of its file."""


def offset_file(file: Path) -> Path:
    """Return the path of the offset of a `file`."""
    return file.with_name(file.name + SUFFIX)


def write_offset(file: Path, origin: Tensor | None) -> str | None:
    """Write the offset of a file, or remove the offset of an earlier file of the same name.

    Args:
        file: path of the file.
        origin: (3,) local origin of the file's coordinates; None for the input's origin.

    Returns:
        A sentence for the user about the offset; None without one.

    Raises:
        OSError: if the offset cannot be written or removed.
    """
    beside = offset_file(file)
    if origin is None:
        beside.unlink(missing_ok=True)
        return None
    text = json.dumps({"offset": origin.tolist()}) + "\n"
    write_atomically(beside, lambda stream: stream.write(text.encode()))
    place = ", ".join(f"{value:.10g}" for value in origin.tolist())
    return (
        f"{file.name} is in float32, too coarse this far from the origin. So its coordinates are relative to "
        f"({place}); add this offset, also in {beside.name}, to get the input's coordinates"
    )


def read_offset(file: Path) -> Tensor:
    """Return the offset (3,) float64 of a `file`; zeros if it has no offset file.

    Raises:
        DataError: if the offset cannot be read, or is not three finite numbers.
    """
    beside = offset_file(file)
    if not beside.exists():
        return torch.zeros(3, dtype=torch.float64)
    content = read_json(beside)
    values = content.get("offset") if isinstance(content, dict) else None
    numbers = values if isinstance(values, list) and all(type(value) in (int, float) for value in values) else []
    if len(numbers) != 3 or not all(abs(value) < math.inf for value in numbers):
        raise DataError(f"{beside}: 'offset' is {shown(values)}; it must be three numbers")
    return torch.tensor([float(value) for value in numbers], dtype=torch.float64)
