"""Commands that browsers start: one at a time, each in a process of its own."""

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
    """The command that a browser has started, if any. Its messages are printed on the viewer's terminal."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None
        self._lock = threading.Lock()

    def run(self, module: str, arguments: Sequence[object], tell: Tell) -> int | None:
        """Run a command, and return its exit status; None if another command is running.

        Args:
            module: module of the command, such as nerfloom.cli.render.
            arguments: its arguments.
            tell: function that is called with each line that it prints.
        """
        with self._lock:
            if self._process is not None and self._process.poll() is None:
                return None
            self._process = process = subprocess.Popen(
                python_command(module, *arguments),
                stdin=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
                errors="replace",
                env={**os.environ, PROGRESS: OFTEN},
            )
        assert process.stderr is not None
        with process.stderr:
            for line in filter(None, map(str.strip, process.stderr)):
                found = PERCENT.search(line)
                if found is None:
                    say(line)
                tell(line, None if found is None else min(int(found[1]), 100))
        return process.wait()

    def close(self) -> None:
        """Stop the command that is running."""
        process = self._process
        if process is not None and process.poll() is None:
            process.terminate()
            say("viewer: a command was stopped; repeat ns-render with the same path to continue a video")
