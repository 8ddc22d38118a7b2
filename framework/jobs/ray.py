"""Jobs on a Ray cluster that shares a file system with this machine; without an address, on this machine alone.

Ray decides where a job runs and notices lost workers. A job's output and results are files, which the worker writes
where this process reads them, so they are the same as with local processes. A job of a lost worker is resumed
elsewhere. Ray: Moritz et al. 2018, "Ray: A Distributed Framework for Emerging AI Applications".
"""

from __future__ import annotations

import os
import secrets
import socket
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nerfloom.base.console import say
from nerfloom.base.errors import ConfigError
from nerfloom.base.extras import require
from nerfloom.base.signals import stoppable
from nerfloom.jobs.child import GRACE
from nerfloom.jobs.execution import execute
from nerfloom.jobs.head import Head
from nerfloom.jobs.job import Failure, Job
from nerfloom.jobs.launcher import Launcher, Ledger, nothing

LOOK_EVERY = 0.5
"""Seconds between looks at the head of the cluster, and at a signal of the user, while jobs run."""
MAX_LOST = 5
"""Number of workers that a job may lose before it counts as failed."""
PASSED_ON = "NERFLOOM_"
"""Start of the names of environment variables that workers get from here."""


@dataclass(frozen=True)
class Ray(Launcher):
    """The launcher of jobs on a Ray cluster.

    Args:
        at_once: maximum number of simultaneous jobs; None for all that have room.
        address: address of a running cluster, such as 10.0.0.1:6379 or auto; None to start one on this machine.
    """

    at_once: int | None = None
    address: str | None = None

    @property
    def sharing(self) -> str | None:
        return "Ray chose the machines, and may have run several at a time on one."

    def run(self, jobs: Sequence[Job], on_finished: Callable[[Job], None] = nothing) -> dict[Job, Failure]:
        """Run every unfinished job, as in `Launcher`.

        Raises:
            LostProcessError: if the head of the cluster is lost.
        """
        require("cluster", "--launcher ray needs")
        ledger = Ledger(jobs, on_finished)
        waiting = ledger.unfinished()
        if not waiting:
            return ledger.failures
        with _cluster(self.address) as ray:
            _check_shared(ray, Path(os.path.commonpath([job.log.parent for job in waiting])))
            _warn_of_room(ray, waiting)
            with stoppable() as stopped:
                head = Head(ray.get_runtime_context().gcs_address)
                _run(ray, head, waiting, self.at_once or len(waiting), ledger, stopped)
        return ledger.failures


@contextmanager
def _cluster(address: str | None) -> Iterator[Any]:
    """Connect with a cluster, or start one, and yield the module `ray`."""
    import ray

    from nerfloom.base.device import num_cores

    # This process prints all messages; workers write files.
    options: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
    if address is None:
        options |= {"num_cpus": num_cores(), "include_dashboard": False}
    try:
        ray.init(address or "local", **options)
    except Exception as error:  # Ray raises plain ones too, such as of a head that does not start in time
        first = (str(error).strip().splitlines() or [type(error).__name__])[0]
        if address is None:
            raise ConfigError(f"cannot start Ray here: {first}") from error
        advice = "if the cluster asks for a token, set RAY_AUTH_MODE=token"
        raise ConfigError(f"--ray-address {address}: cannot connect: {first} ({advice})") from error
    try:
        yield ray
    finally:
        ray.shutdown()


def _check_shared(ray: Any, folder: Path) -> None:
    """Check that every machine of the cluster sees the files in `folder`, by a file that is written here.

    Raises:
        ConfigError: if one does not, or the folder cannot be written.
    """
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    token = folder / f".shared-{secrets.token_hex(8)}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        token.touch()
    except OSError as error:
        raise ConfigError(f"cannot write {folder}: {error.strerror}") from error
    try:
        look = ray.remote(num_cpus=0, max_retries=0)(_sees)
        places = [NodeAffinitySchedulingStrategy(node["NodeID"], soft=False) for node in _machines(ray)]
        answers = ray.get([look.options(scheduling_strategy=place).remote(str(token)) for place in places])
    finally:
        token.unlink()
    if blind := sorted({host for host, sees in answers if not sees}):
        raise ConfigError(
            f"the machine {blind[0]} of the cluster does not see {folder}; name a folder on a file system that all of "
            "its machines share"
        )


def _machines(ray: Any) -> list[dict[str, Any]]:
    """Return Ray's descriptions of the machines that are there now."""
    return [node for node in ray.nodes() if node["Alive"]]


def _warn_of_room(ray: Any, jobs: Sequence[Job]) -> None:
    """Say so if a job has to wait for a machine that is not there; a cluster may grow."""
    for cores, gpus in sorted({(job.resources.cores or 1, job.resources.gpus) for job in jobs}):
        found = [node["Resources"] for node in _machines(ray)]
        if not any(each.get("CPU", 0) >= cores and each.get("GPU", 0) >= gpus for each in found):
            say(f"warning: no machine of the cluster has {cores} cores and {gpus} GPUs; jobs wait until one has")


def _sees(path: str) -> tuple[str, bool]:
    """Return this machine's name and whether it sees a file."""
    return socket.gethostname(), os.path.exists(path)


def _work(job: dict[str, Any], folder: str, environment: dict[str, str]) -> str | None:
    """Run a job on a worker, and return why it failed."""
    own = {name: value for name, value in os.environ.items() if name != "OMP_NUM_THREADS"}  # which Ray has set
    return execute(job, {**own, **environment}, Path(folder), threading.Event())


def _run(ray: Any, head: Head, waiting: list[Job], at_once: int, ledger: Ledger, stopped: threading.Event) -> None:
    """Run jobs until all have ended, the user stops them, or the head is lost."""
    work, lost = ray.remote(max_retries=0)(_work), dict.fromkeys(waiting, 0)
    queue, running, there = list(reversed(waiting)), dict[Any, Job](), True
    try:
        while (queue or running) and not stopped.is_set():
            there = head.answers()  # without it Ray would block
            while there and queue and len(running) < at_once:
                job = queue.pop()
                if not lost[job]:
                    ledger.started(job)
                running[_submitted(ray, work, job)] = job
            if not running:
                stopped.wait(LOOK_EVERY)  # until the head is back
            for reference in ray.wait(list(running), timeout=LOOK_EVERY)[0]:
                job = running.pop(reference)
                try:
                    ledger.ended(job, ray.get(reference))
                except ray.exceptions.RayTaskError as error:  # an error of ours in the worker
                    ledger.ended(job, _first_line(error.cause))
                except ray.exceptions.RayError as error:
                    lost[job] += 1
                    if _goes_on(job, lost[job], error, ledger):
                        queue.append(job)
    finally:
        for reference in running:
            ray.cancel(reference)  # raises KeyboardInterrupt there, so that the job saves
        if running and there:  # a lost head would not tell when they have saved
            ray.wait(list(running), num_returns=len(running), timeout=GRACE)


def _goes_on(job: Job, lost: int, error: Exception, ledger: Ledger) -> bool:
    """Report that a job has lost a worker, and return whether it runs again."""
    if lost > MAX_LOST:
        ledger.ended(job, f"it lost {lost} workers, the last by {_first_line(error)}")
        return False
    why = _first_line(error).partition(". ")[0]  # then comes a paragraph about Ray's own commands
    say(f"  {job.title}: worker lost ({why}); the job continues on another, {lost} of {MAX_LOST}")
    return True


def _submitted(ray: Any, work: Any, job: Job) -> Any:
    """Give a job to the cluster, and return Ray's reference of its result."""
    cores, environment = job.resources.cores, {k: v for k, v in os.environ.items() if k.startswith(PASSED_ON)}
    if cores is None:
        found = [int(node["Resources"].get("CPU", 0)) for node in _machines(ray)]
        cores = min((each for each in found if each), default=1)  # a head may offer none
    else:
        environment["OMP_NUM_THREADS"] = str(cores)
    options = work.options(num_cpus=cores, num_gpus=job.resources.gpus)
    return options.remote(job.as_plain(), os.getcwd(), environment)


def _first_line(error: BaseException) -> str:
    """Return the kind of an error and the first line of its message."""
    return ": ".join([type(error).__name__, *str(error).strip().splitlines()[:1]])
