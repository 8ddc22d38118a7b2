"""Measurements in separate processes, unaffected by earlier measurements."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence

from nerfloom.base.errors import NerfloomError


def own_command(name: str, *arguments: object) -> list[str]:
    """Return the command line that runs the module `name` of this folder with `arguments`, in the repository's root."""
    return [sys.executable, "-m", f"benchmarks.{name}", *map(str, arguments)]


def output_of(command: Sequence[str]) -> str:
    """Run a `command`, as from `python_command`, to its end and return its standard output.

    Raises:
        NerfloomError: if it fails; the message has the last line of its standard error.
    """
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        lines = done.stderr.strip().splitlines() or [f"exit status {done.returncode}"]
        raise NerfloomError(f"a process of the benchmark failed: {lines[-1]}")
    return done.stdout
