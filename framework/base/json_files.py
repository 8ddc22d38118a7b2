"""Reading of JSON files from elsewhere, with errors on one line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

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
