"""Measurements in separate processes, unaffected by earlier measurements."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence

from nerfloom.base.errors import NerfloomError


def own_command(name: str, *arguments: object) -> list[str]:
    """Return the command line that runs a module of this folder as a program, from the root of the repository.

    Args:
        name: name of the module.
        arguments: command-line arguments, converted to strings.
    """
    return [sys.executable, "-m", f"benchmarks.{name}", *map(str, arguments)]


def output_of(command: Sequence[str]) -> str:
    """Run a command to its end and return its standard output.

    Args:
        command: a program and its arguments, as from `python_command`.

    Raises:
        NerfloomError: if it fails; the message has the last line of its standard error.
    """
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        lines = done.stderr.strip().splitlines() or [f"exit status {done.returncode}"]
        raise NerfloomError(f"a process of the benchmark failed: {lines[-1]}")
    return done.stdout
