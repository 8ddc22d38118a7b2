"""Files of results: one JSON file per table, with its `rows` by name and one line per row."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from nerfloom.base.atomic import write_atomically
from nerfloom.base.errors import ConfigError
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
    """Write finite plain data `result` as the row `name` of a JSON `file`.

    The file and its folder are created if missing. A row is one line, so a difference between two versions of the file
    names the rows that changed.

    Raises:
        ConfigError: if the file exists and holds something else.
        ValueError: if `result` holds a number that is not finite.
    """
    rows = sorted({**read_rows(file), name: result}.items())
    lines = ",\n".join(f"{json.dumps(each)}: {json.dumps(row, allow_nan=False)}" for each, row in rows)
    file.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(file, lambda opened: opened.write(f'{{"rows": {{\n{lines}\n}}}}\n'.encode()))
