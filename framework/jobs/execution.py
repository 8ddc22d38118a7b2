"""One job on this machine, in a process that ends when this one does."""

from __future__ import annotations

import json
import subprocess
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from nerfloom.base.child import python_command
from nerfloom.jobs.child import reason

LOOK_EVERY = 0.1
"""Seconds between looks at a running job."""


def execute(
    job: Mapping[str, Any],
    environment: Mapping[str, str],
    folder: Path,
    stopped: threading.Event,
    look: Callable[[], object] = lambda: None,
) -> str | None:
    """Run a job to its end.

    Args:
        job: the job as plain data, from `Job.as_plain`.
        environment: environment variables.
        folder: working folder.
        stopped: set if the job is to end early; like an exception here, it lets the job save.
        look: called several times a second.

    Returns:
        Why it failed; None if all commands succeeded.
    """
    # In its own session, so that Ctrl-C reaches it only once, from this process.
    process = subprocess.Popen(
        python_command("nerfloom.jobs.child"),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env={**environment, "PYTHONUNBUFFERED": "1"},
        cwd=folder,
        start_new_session=True,
    )
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        with suppress(BrokenPipeError):  # it has ended already
            process.stdin.write(json.dumps(job).encode() + b"\n")
            process.stdin.flush()
        while process.poll() is None and not stopped.wait(LOOK_EVERY):
            look()
    finally:
        with suppress(BrokenPipeError):  # closing writes the buffered rest again
            process.stdin.close()
        process.wait()
    said = process.stdout.read().decode(errors="replace").strip()
    process.stdout.close()
    return None if process.returncode == 0 else said or reason(process.returncode, Path(job["log"]))
