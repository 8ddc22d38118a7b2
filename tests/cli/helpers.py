"""Run the installed commands as a person would."""

import functools
import io
import os
import subprocess
import sys
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from unittest.mock import patch

from tests.patience import PATIENCE

_FLAGS = "--num-levels 4 --max-resolution 64 --log2-table-size 12 --grid-resolution 16 --num-steps 64 --vis none"
TINY_NGP = [*_FLAGS.split(), "--samples-per-batch", "4096"]


def command(name: str) -> str:
    """The path of an installed command, beside this interpreter."""
    return str(Path(sys.executable).with_name(name))


def run(name: str, *arguments: object, folder: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run a command and capture what it prints."""
    words = [command(name), *map(str, arguments)]
    return subprocess.run(words, capture_output=True, text=True, cwd=folder, timeout=PATIENCE)


def called(name: str, *arguments: object, folder: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run a short command within this process, which saves the second that a new process takes to begin."""
    return done_here(_entry(name).load(), [name, *map(str, arguments)], folder)


@functools.cache  # to look through all installed packages takes longer than many a command
def _entry(name: str) -> EntryPoint:
    (entry,) = entry_points(group="console_scripts", name=name)
    return entry


def benchmarked(*arguments: object) -> subprocess.CompletedProcess[str]:
    """The same of `python -m benchmarks`."""
    from benchmarks.__main__ import main

    return done_here(main, ["benchmarks", *map(str, arguments)])


def done_here(
    main: Callable[[], None], words: list[str], folder: Path | None = None
) -> subprocess.CompletedProcess[str]:
    """Call `main` within this process, with `words` as the command line, in `folder` or the working folder."""
    here = Path.cwd()
    code, out, err = 0, io.StringIO(), io.StringIO()
    os.chdir(folder or here)
    try:
        with patch.object(sys, "argv", words), redirect_stdout(out), redirect_stderr(err):
            main()
    except SystemExit as end:
        code = int(end.code or 0)
    finally:
        os.chdir(here)
    return subprocess.CompletedProcess(words, code, out.getvalue(), err.getvalue())


def train(data: Path, output: Path, *flags: object, timestamp: str = "t") -> Path:
    """Train the tiny instant-ngp in this process; returns the run's folder."""
    done = called(
        "ns-train", "instant-ngp", "--data", data, "--output-dir", output, "--timestamp", timestamp, *TINY_NGP, *flags
    )
    assert done.returncode == 0, done.stderr
    return output / data.name / "instant-ngp" / timestamp
