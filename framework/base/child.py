"""Command lines that run a module of this package in a child process."""

import sys

SAFE = ("-P",) if sys.version_info >= (3, 11) else ()
"""Keeps the working folder off Python's path: a file there could hide a package of the same name."""


def python_command(module: str, *arguments: object) -> list[str]:
    """Return the command line that runs a `module`, such as nerfloom.cli.train, with `arguments`, from any folder."""
    return [sys.executable, *SAFE, "-m", module, *map(str, arguments)]
