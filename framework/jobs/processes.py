"""Jobs in child processes on this machine: one after the other, or several that share its cores or have a GPU each."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from queue import Queue

from rich.status import Status

from nerfloom.base.console import console
from nerfloom.base.errors import ConfigError
from nerfloom.base.signals import stoppable
from nerfloom.jobs.child import last_line
from nerfloom.jobs.execution import execute
from nerfloom.jobs.job import Failure, Job
from nerfloom.jobs.launcher import Launcher, Ledger, nothing


@dataclass(frozen=True)
class Processes(Launcher):
    """The launcher of jobs on this machine.

    Args:
        at_once: number of simultaneous jobs. Several have a GPU each, or share the cores by their `Resources.cores`.
    """

    at_once: int = 1

    @property
    def sharing(self) -> str | None:
        return None if self.at_once == 1 else f"{self.at_once} runs at a time on one machine."

    def run(self, jobs: Sequence[Job], on_finished: Callable[[Job], None] = nothing) -> dict[Job, Failure]:
        ledger = Ledger(jobs, on_finished)
        waiting = ledger.unfinished()
        places: Queue[Mapping[str, str]] = Queue()
        for place in places_for(waiting, self.at_once):
            places.put(place)

        def work(job: Job) -> str | None:
            if stopped.is_set():
                return None
            place = places.get()
            try:
                ledger.started(job)
                with self._status(job) as look:
                    return execute(job.as_plain(), {**_environment(job), **place}, Path.cwd(), stopped, look)
            finally:
                places.put(place)

        with stoppable() as stopped, ThreadPoolExecutor(self.at_once) as pool:
            try:
                futures = {pool.submit(work, job): job for job in waiting}
                for future in as_completed(futures):
                    if not stopped.is_set() or futures[future].finished():
                        ledger.ended(futures[future], future.result())
            except BaseException:
                stopped.set()  # the pool waits for its jobs, which save
                raise
        return ledger.failures

    @contextmanager
    def _status(self, job: Job) -> Iterator[Callable[[], object]]:
        """Show the last line of a job's output. A terminal can show only one, so simultaneous jobs have none."""
        alone = console.is_terminal and self.at_once == 1
        with Status(job.title, console=console) if alone else nullcontext() as status:
            yield lambda: None if status is None else status.update(f"{job.title}: {last_line(job.log)}")


def _environment(job: Job) -> dict[str, str]:
    cores = job.resources.cores
    return {**os.environ, **({} if cores is None else {"OMP_NUM_THREADS": str(cores)})}


def places_for(jobs: Sequence[Job], at_once: int) -> list[dict[str, str]]:
    """Return the environment variables that give each of `at_once` simultaneous `jobs` its part of this machine.

    Raises:
        ConfigError: if the machine has too few GPUs, or too few cores.
    """
    if at_once == 1 or not jobs:
        return [{}] * at_once
    if any(job.resources.gpus for job in jobs):
        return [{"CUDA_VISIBLE_DEVICES": name} for name in _gpus(at_once)]
    from nerfloom.base.device import num_cores

    cores, available = [job.resources.cores for job in jobs], num_cores()
    most = max((available if each is None else each) for each in cores)
    if most * at_once > available:
        raise ConfigError(
            f"--jobs {at_once} with {most} threads each needs {at_once * most} CPU cores, and there are {available}; "
            + (
                f"use --num-threads {available // at_once}, since runs that share a core slow each other down"
                if available >= at_once
                else f"use --jobs {available} --num-threads 1"
            )
        )
    return [{}] * at_once


def _gpus(count: int) -> list[str]:
    """Return names of CUDA devices, as for CUDA_VISIBLE_DEVICES."""
    import torch

    available = torch.cuda.device_count()
    if count > available:
        raise ConfigError(
            f"--jobs {count} needs as many CUDA devices, and there are {available}: runs that share one would "
            "slow each other down, so that times would not be comparable"
        )
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    names = visible.split(",") if visible else [str(number) for number in range(available)]
    return names[:count]
