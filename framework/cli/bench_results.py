"""Choice of a benchmark, and its result files, for `ns-bench` and `python -m benchmarks`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from nerfloom.base.console import say
from nerfloom.base.json_files import write_json
from nerfloom.cli.common import chosen_kind
from nerfloom.cli.flags import read_flags
from nerfloom.training.run_path import check_data

RESULTS = Path("docs/results")
"""Default folder of the results."""
PICTURES = Path("docs/pictures")
"""Default folder of pictures."""


def run_benchmark(
    command: str, arguments: list[str], kinds: Mapping[str, tuple[type, Callable[[Any], None]]], usage: str
) -> None:
    """Run the benchmark of `kinds`, flags and function by name, that `arguments` name, or print the help.

    `command` and `usage` are for the help.
    """
    name, (flags, run), rest = chosen_kind(arguments, kinds, usage, "there is no benchmark")
    settings: Any = read_flags(flags, f"{command} {name}", rest)
    if getattr(settings, "data", None) is not None:
        check_data(settings.data)
    run(settings)


def write_results(path: Path, content: dict[str, Any]) -> None:
    """Write plain data `content` as JSON to `path`, in a folder that is created if missing, and print the path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, content)
    say(f"written to {path}")
