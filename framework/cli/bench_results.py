"""Result files of `ns-bench`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from nerfloom.base.console import say

RESULTS = Path("docs/results")
"""Default folder of the results."""
PICTURES = Path("docs/pictures")
"""Default folder of pictures."""


def write_results(path: Path, content: dict[str, Any]) -> None:
    """Write plain data as JSON, and print the path.

    Args:
        path: the file; its folder is created if missing.
        content: the data.
    """
    from nerfloom.training.run import write_json

    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, content)
    say(f"written to {path}")
