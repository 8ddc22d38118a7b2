"""A job: commands that run one after the other. The files that they leave show whether it is finished."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Step:
    """A command of a job.

    Args:
        command: program and arguments.
        started: file that the command writes early; if it exists, `resume` is run instead of `command`.
        resume: command that continues where an earlier one was stopped; required with `started`.

    Raises:
        ValueError: if a command is missing.
    """

    command: tuple[str, ...]
    started: Path | None = None
    resume: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.command or bool(self.resume) != (self.started is not None):
            raise ValueError("a step needs a command, and with `started` another that resumes it")


@dataclass(frozen=True)
class Resources:
    """Needs of a job on a machine: CPU `cores`, all if None, and `gpus`."""

    cores: int | None = None
    gpus: int = 0


@dataclass(frozen=True)
class Job:
    """Commands that run one after the other. A job that was stopped resumes when it is run again.

    Args:
        title: name of the job in messages.
        description: a short description, such as the budget, for the message at its start.
        steps: the commands.
        log: file for the output of the commands.
        finished: returns whether the job's files are complete; called where the jobs are launched.
        resources: cores and GPUs that the job needs.
    """

    title: str
    description: str
    steps: tuple[Step, ...]
    log: Path
    finished: Callable[[], bool]
    resources: Resources = Resources()

    def as_plain(self) -> dict[str, Any]:
        """Return the job as plain data, so that another process can run it."""
        steps = [
            {
                "command": list(step.command),
                "started": None if step.started is None else str(step.started),
                "resume": list(step.resume),
            }
            for step in self.steps
        ]
        return {"steps": steps, "log": str(self.log)}


@dataclass(frozen=True)
class Failure:
    """A failed job."""

    reason: str
    """Last line of its output, or the signal that ended it."""
    log: Path
    """File of its output."""
