"""Files of results: one JSON file per table, with its `rows` by name."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from nerfloom.base.errors import ConfigError
from nerfloom.base.json_files import write_json
from nerfloom.comparison.measures import read_json


def read_rows(file: Path) -> dict[str, Any]:
    """Return the rows of a JSON `file` of results by name; none if there is no such file.

    Raises:
        ConfigError: if it is not a file of results.
    """
    if not file.exists() or not file.stat().st_size:
        return {}
    found = read_json(file)
    if not isinstance(found, dict) or not isinstance(rows := found.get("rows"), dict):
        raise ConfigError(f"{file} is not a file of results, because it has no rows by name; give another path")
    return rows


def add_row(file: Path, name: str, result: Any) -> None:
    """Write plain data `result` as the row `name` of a JSON `file`, which is created with its folder if missing.

    Raises:
        ConfigError: if the file exists and holds something else.
    """
    file.parent.mkdir(parents=True, exist_ok=True)
    write_json(file, {"rows": dict(sorted({**read_rows(file), name: result}.items()))})
