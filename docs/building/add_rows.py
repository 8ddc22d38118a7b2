"""Adds evaluations to a file of results: `python docs/building/add_rows.py docs/results/captures.json FILE.json ...`.

A file comes from `ns-eval`, and its name is the name of its row: `statue-zip-nerf-600s-half.json`. A row of that
name is replaced. `python -m benchmarks tables` adds the rows of its tables by itself.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from nerfloom.benchmarks.results import add_row


def main(table: str, *files: str) -> None:
    """Add the files to the table."""
    for file in map(Path, files):
        add_row(Path(table), file.stem, json.loads(file.read_text(encoding="utf-8")))


if __name__ == "__main__":
    main(*sys.argv[1:])
