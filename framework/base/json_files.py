"""JSON files: read from elsewhere with errors on one line, and written whole."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from nerfloom.base.atomic import write_atomically
from nerfloom.base.errors import DataError, shown
from nerfloom.base.lfs import ADVICE, is_pointer


def read_json(file: Path) -> Any:
    """Read the content of the JSON `file`, in UTF-8, or in UTF-16 or UTF-32, which programs of Windows write.

    Raises:
        DataError: if the file cannot be read, or is not JSON.
    """
    try:
        return json.loads(file.read_bytes())
    except OSError as error:
        raise DataError(f"cannot read {file}: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise DataError(f"{file} is not JSON: {ADVICE if is_pointer(file) else error}") from error


def read_object(file: Path) -> dict[str, Any]:
    """Read the object in the JSON `file`.

    Raises:
        DataError: if the file cannot be read, is not JSON, or does not hold an object.
    """
    content = read_json(file)
    if not isinstance(content, dict):
        raise DataError(f"{file} must contain a JSON object: names and values in braces")
    return content


def number(value: Any, name: str, where: str, positive: bool = False) -> float:
    """Return a finite number.

    Args:
        value: the entry's value; None if it is missing.
        name: name of the entry in the message.
        where: name of the file and frame in the message.
        positive: whether the number must be positive.

    Raises:
        DataError: if the value is not such a number.
    """
    expected = "a number above zero" if positive else "a number"
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    try:
        result = float(value) if is_number else math.nan
    except OverflowError:
        result = math.inf
    if not math.isfinite(result) or (positive and result <= 0):
        raise DataError(f"{where}: '{name}' is {shown(value)}; it must be {expected}")
    return result


def write_json(path: Path, content: Any) -> None:
    """Write finite plain `content` as indented JSON to `path`, atomically.

    Raises:
        OSError: if the file cannot be written.
    """
    text = json.dumps(content, indent=2, allow_nan=False) + "\n"
    write_atomically(path, lambda file: file.write(text.encode()))


def finite_or_null(content: Any) -> Any:
    """Return plain `content` with None for each non-finite number, since JSON has none."""
    if isinstance(content, dict):
        return {name: finite_or_null(value) for name, value in content.items()}
    if isinstance(content, list | tuple):
        return [finite_or_null(value) for value in content]
    return None if isinstance(content, float) and not math.isfinite(content) else content
