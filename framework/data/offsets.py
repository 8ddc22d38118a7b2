"""Offsets of files that are written about a local origin, since float32 is too coarse for their coordinates.

Beside such a file NAME is NAME.offset.json, with `offset`, three numbers: a position of the file plus the offset is the
position in the frame of the input. A file without one has its coordinates in that frame.
"""

from __future__ import annotations

import json
import math
from pathlib import Path

import torch
from torch import Tensor

from nerfloom.base.atomic import write_atomically
from nerfloom.base.errors import DataError, shown

SUFFIX = ".offset.json"
"""What the name of a file's offset adds to that of the file."""


def offset_file(file: Path) -> Path:
    """Return the path of the offset of a `file`."""
    return file.with_name(file.name + SUFFIX)


def write_offset(file: Path, origin: Tensor | None) -> str | None:
    """Write the offset of a file, or remove that of an earlier file of the same name.

    Args:
        file: path of the file.
        origin: (3,) local origin about which the file is written; None for the input's own.

    Returns:
        A sentence that says where the file is; None if it is where the input is.

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
        f"{file.name} holds float32, which is too coarse so far from the origin: its coordinates are counted from "
        f"({place}), which {beside.name} says too; add it to get those of the input"
    )


def read_offset(file: Path) -> Tensor:
    """Return the offset (3,) float64 of a file: zeros if there is none beside it.

    Args:
        file: path of the file.

    Raises:
        DataError: if the offset cannot be read, or is not three finite numbers.
    """
    beside = offset_file(file)
    try:
        content = json.loads(beside.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return torch.zeros(3, dtype=torch.float64)
    except OSError as error:
        raise DataError(f"cannot read {beside}: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise DataError(f"{beside} is not JSON: {error}") from error
    values = content.get("offset") if isinstance(content, dict) else None
    numbers = values if isinstance(values, list) and all(type(value) in (int, float) for value in values) else []
    if len(numbers) != 3 or not all(abs(value) < math.inf for value in numbers):
        raise DataError(f"{beside}: 'offset' is {shown(values)}; it must be three numbers")
    return torch.tensor([float(value) for value in numbers], dtype=torch.float64)
