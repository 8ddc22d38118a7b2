"""A program that runs one job: `python -m nerfloom.jobs.child < JOB`, where JOB is a line of JSON (`Job.as_plain`).

It ends with its standard input, so a job ends, after it has saved, when whoever started it is killed. Its exit status
is 0 if all commands succeeded; else its standard output has the reason in one line.
"""

from __future__ import annotations

import ctypes
import json
import os
import shlex
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

from nerfloom.base.errors import printable
from nerfloom.base.file_lock import locked

LOOK_EVERY = 0.1
"""Seconds between looks at whether the job is to end early."""
GRACE = 60.0
"""Seconds for a command to save before it is killed."""
COMMAND = "$ "
"""Start of a log's lines that show a command."""
ALONE = "waiting until an earlier process of this job has ended"
"""Line of a log that another process still writes."""


def main() -> None:
    """Run the job on standard input, and exit."""
    with open(0, "rb", buffering=0, closefd=False) as stdin:
        job = json.loads(stdin.readline())
        abandoned = threading.Event()

        def wait_for_the_end() -> None:
            stdin.read(1)
            abandoned.set()

        threading.Thread(target=wait_for_the_end, daemon=True).start()
        if (reason := run(job, abandoned)) is not None:
            print(reason, flush=True)
            sys.exit(1)


def run(job: dict[str, Any], abandoned: threading.Event) -> str | None:
    """Run the commands of a job, one after the other.

    Args:
        job: the job as plain data.
        abandoned: set if the job is to end early.

    Returns:
        Why it failed; None if all commands succeeded.
    """
    path = Path(job["log"])
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("ab") as log:
            if not locked(log.fileno()):
                print(ALONE, file=sys.stderr)
                log.write(f"{ALONE}\n".encode())
                log.flush()
                while not locked(log.fileno()):
                    if abandoned.wait(LOOK_EVERY):
                        return "stopped"
            for step in job["steps"]:
                again = step["started"] is not None and os.path.exists(step["started"])
                if code := _run(step["resume"] if again else step["command"], log, abandoned):
                    return reason(code, path)
                if abandoned.is_set():
                    return "stopped"
    except OSError as error:
        return f"{error.filename or path}: {error.strerror or error}"
    return None


def _run(command: list[str], log: BinaryIO, abandoned: threading.Event) -> int:
    """Run a command and return its exit status. Its output goes to the job's log."""
    log.write(f"{COMMAND}{printable(shlex.join(command))}\n".encode())
    log.flush()
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, preexec_fn=_end_with_parent())
    while True:
        try:
            return process.wait(timeout=LOOK_EVERY)
        except subprocess.TimeoutExpired:
            if abandoned.is_set():
                return _end(process)


def _end(process: subprocess.Popen[bytes]) -> int:
    """Terminate a command after it has saved."""
    process.terminate()
    try:
        return process.wait(timeout=GRACE)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()


def _end_with_parent() -> Callable[[], object] | None:
    """Return a function that asks Linux to terminate the calling process when its parent ends, even by SIGKILL."""
    if sys.platform != "linux":
        return None
    prctl, set_parent_death_signal = ctypes.CDLL(None).prctl, 1
    return lambda: prctl(set_parent_death_signal, signal.SIGTERM)


def reason(code: int, log: Path) -> str:
    """Return why a command failed, by its exit status `code` or minus a signal, or the last line of its `log`."""
    number = -code if code < 0 else code - 128
    if number in signal.valid_signals():
        name = signal.Signals(number).name
        return f"ended by {name}" + (" (too little memory?)" if name == "SIGKILL" else "")
    said = last_line(log).removeprefix("error: ")
    return f"exit status {code}" if not said or said.startswith(COMMAND) else said


def last_line(log: Path) -> str:
    """Return the last non-empty line of the file `log`; an empty text if it cannot be read."""
    try:
        with log.open("rb") as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(max(size - 4096, 0))
            lines = file.read().decode("utf-8", errors="replace").replace("\r", "\n").splitlines()
    except OSError:
        return ""
    return next((line.strip() for line in reversed(lines) if line.strip()), "")


if __name__ == "__main__":
    main()
