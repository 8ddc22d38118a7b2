"""Commands that browsers start on what is shown: one at a time, each in a process of its own."""

from __future__ import annotations

import os
import re
import subprocess
import threading
from collections.abc import Callable, Sequence

from nerfloom.base.child import python_command
from nerfloom.base.console import OFTEN, PROGRESS, say

PERCENT = re.compile(r": (\d+) %, ")
"""The finished percentage in a line of progress (`Meter.line`)."""
Tell = Callable[[str, "int | None"], None]
"""Function of a line that a command prints, and the finished percentage, None if the line is no progress."""


class Commands:
    """The command that a browser has started, if any.

    Args:
        opens: words of the command line that open the run or file that is shown, in the same frame.
    """

    def __init__(self, opens: Sequence[str]) -> None:
        self.opens = opens
        self._process: subprocess.Popen[str] | None = None
        self._is_closed = False
        self._lock = threading.Lock()

    def start(self, module: str, arguments: Sequence[object]) -> subprocess.Popen[str] | None:
        """Start a `module` with `arguments`; return its process, or None if another runs or the viewer ends."""
        with self._lock:
            if self._is_closed or (self._process is not None and self._process.poll() is None):
                return None
            self._process = subprocess.Popen(
                python_command(module, *arguments),
                stdin=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
                errors="replace",
                env={**os.environ, PROGRESS: OFTEN},
            )
            return self._process

    def close(self) -> None:
        """Stop the command that is running, and start no other."""
        with self._lock:
            self._is_closed, process = True, self._process
        if process is not None and process.poll() is None:
            process.terminate()
            say("viewer: a command was stopped; repeat ns-render with the same path to continue a video")


def follow(process: subprocess.Popen[str], tell: Tell) -> int:
    """Print and `tell` each line of a `process` of `Commands.start` until it ends, and return its exit status."""
    assert process.stderr is not None
    with process.stderr:
        for line in filter(None, map(str.strip, process.stderr)):
            found = PERCENT.search(line)
            if found is None:
                say(line)
            tell(line, None if found is None else min(int(found[1]), 100))
    return process.wait()
