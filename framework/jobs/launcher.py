"""The interface of launchers, and the messages about jobs that all of them print."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence

from nerfloom.base.console import say
from nerfloom.base.errors import FlagError
from nerfloom.jobs.job import Failure, Job


def nothing(job: Job) -> None:
    """Ignore a finished job."""


class Launcher(ABC):
    """A way to run jobs: on this machine, or on others that share its files.

    Jobs write the same files with every launcher. Finished jobs are not run again, and stopped jobs are resumed. So the
    same call, even with another launcher, continues after an interruption.

    Raises:
        FlagError: if `at_once` is less than 1.
    """

    at_once: int | None
    """Maximum number of simultaneous jobs; None for all that have room."""

    def __post_init__(self) -> None:
        if self.at_once is not None and self.at_once < 1:
            raise FlagError(f"--jobs is {self.at_once}; it must be at least 1")

    @property
    @abstractmethod
    def sharing(self) -> str | None:
        """A sentence for reports on other work on a job's machine; None if jobs ran one after the other."""

    @abstractmethod
    def run(self, jobs: Sequence[Job], on_finished: Callable[[Job], None] = nothing) -> dict[Job, Failure]:
        """Run every unfinished job; failures are reported, and the other jobs continue.

        Args:
            jobs: the jobs, in the order of their starts.
            on_finished: called in this thread with each job that is finished, at once.

        Returns:
            The failed jobs.

        Raises:
            ConfigError: if the jobs cannot run this way.
            Stopped: on a signal, after the running jobs have saved.
        """


class Ledger:
    """The state of a launcher's `jobs`, told at every change; `on_finished` is called with each finished job."""

    def __init__(self, jobs: Sequence[Job], on_finished: Callable[[Job], None]) -> None:
        self.failures: dict[Job, Failure] = {}
        """The failed jobs."""
        self._numbers = {job: f"[{number}/{len(jobs)}]" for number, job in enumerate(jobs, 1)}
        self._on_finished = on_finished

    def unfinished(self) -> list[Job]:
        """Return the jobs that have to run, and report the others."""
        waiting = []
        for job, number in self._numbers.items():
            if job.finished():
                say(f"{number} {job.title}: already finished")
                self._on_finished(job)
            else:
                waiting.append(job)
        return waiting

    def started(self, job: Job) -> None:
        """Report the start of a job."""
        say(f"{self._numbers[job]} {job.title}: {job.description}")

    def ended(self, job: Job, reason: str | None) -> None:
        """Report the end of a `job`, with the `reason` if it failed, else None."""
        if reason is None and job.finished():
            self._on_finished(job)
            return
        failure = self.failures[job] = Failure(reason or "it ended without a result", job.log)
        say(f"  {job.title} failed: {failure.reason} (full output: {failure.log})")
