"""JSON files: read from elsewhere with errors on one line, and written whole."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from nerfloom.base.atomic import write_atomically
from nerfloom.base.errors import DataError


def read_json(file: Path) -> Any:
    """Read the content of the JSON `file`.

    Raises:
        DataError: if the file cannot be read, or is not JSON.
    """
    try:
        return json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise DataError(f"cannot read {file}: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise DataError(f"{file} is not JSON: {error}") from error


def read_object(file: Path) -> dict[str, Any]:
    """Read the object in the JSON `file`.

    Raises:
        DataError: if the file cannot be read, is not JSON, or does not hold an object.
    """
    content = read_json(file)
    if not isinstance(content, dict):
        raise DataError(f"{file} must contain a JSON object: names and values in braces")
    return content


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
