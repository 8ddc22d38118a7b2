"""Execution of a comparison's jobs in child processes, one after the other or one per device."""

from __future__ import annotations

import os
import signal
import subprocess
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from queue import Queue

from rich.status import Status

from nerfloom.base.console import console, say
from nerfloom.base.errors import ConfigError, FlagError
from nerfloom.base.signals import NUMBERS, Stopped, handled
from nerfloom.comparison.measures import read_json
from nerfloom.comparison.plan import Conditions, Job, Plan

LOOK_EVERY = 0.5
"""Seconds between updates of the displayed last line of a run's output."""
GRACE = 60.0
"""Seconds for a run to save before it is killed."""


@dataclass(frozen=True)
class Failure:
    """A failed job."""

    reason: str
    """Last line of its output, or the signal that ended it."""
    log: Path
    """File of its output."""


def run_jobs(plan: Plan, jobs_at_once: int = 1) -> dict[Job, Failure]:
    """Train and evaluate every unfinished job; failures are reported, and the other jobs continue.

    Args:
        plan: the comparison.
        jobs_at_once: number of jobs that run in parallel, each on its own CUDA device.

    Returns:
        The failed jobs.

    Raises:
        ConfigError: if there are fewer CUDA devices than parallel jobs.
        Stopped: on a signal, after the running jobs have saved.
    """
    devices: Queue[str | None] = Queue()
    for device in _devices(plan.conditions, jobs_at_once):
        devices.put(device)
    jobs, failures = plan.jobs(), dict[Job, Failure]()

    def work(number: int) -> None:
        job = jobs[number]
        if stopped.is_set():
            return
        if is_done(job):
            say(f"[{number + 1}/{len(jobs)}] {job.title}: already finished")
            return
        device = devices.get()
        try:
            say(f"[{number + 1}/{len(jobs)}] {job.title}: {plan.conditions.budget()}")
            failure = run_job(job, plan.conditions, device, stopped)
        finally:
            devices.put(device)
        if failure is not None and not stopped.is_set():
            failures[job] = failure
            say(f"  {job.title} failed: {failure.reason} (full output: {failure.log})")

    with stoppable() as stopped, ThreadPoolExecutor(jobs_at_once) as pool:
        for future in [pool.submit(work, number) for number in range(len(jobs))]:
            future.result()
    return failures


@contextmanager
def stoppable() -> Iterator[threading.Event]:
    """Yield an event that Ctrl-C and SIGTERM set, so that running jobs can save; then raise `Stopped`.

    Raises:
        Stopped: at the end of the block, if there was a signal.
    """
    stopped, signals = threading.Event(), list[int]()

    def record(number: int, frame: object) -> None:
        signals.append(number)
        stopped.set()

    with handled(NUMBERS, record):
        yield stopped
    if signals:
        raise Stopped(signals[0], "stopped; run the same command to continue")


def _devices(conditions: Conditions, jobs_at_once: int) -> Sequence[str | None]:
    """Return the value of CUDA_VISIBLE_DEVICES for each parallel job; None to leave it unchanged."""
    if jobs_at_once < 1:
        raise FlagError(f"--jobs is {jobs_at_once}; it must be at least 1")
    if jobs_at_once == 1:
        return [None]
    import torch

    available = torch.cuda.device_count() if conditions.device_type in ("auto", "cuda") else 0
    if jobs_at_once > available:
        raise ConfigError(
            f"--jobs {jobs_at_once} needs as many CUDA devices, and there are {available}: runs that share one would "
            "slow each other down, so that times would not be comparable"
        )
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    names = visible.split(",") if visible else [str(number) for number in range(available)]
    return names[:jobs_at_once]


def is_done(job: Job) -> bool:
    """Return whether `job` is completely trained and evaluated, with finite images."""
    summary, evaluation = read_json(job.folder / "summary.json"), read_json(job.evaluation)
    if not isinstance(summary, dict) or summary.get("interrupted") is not False or not isinstance(evaluation, dict):
        return False
    return evaluation.get("results", {}).get("psnr") is not None


def run_job(job: Job, conditions: Conditions, device: str | None, stopped: threading.Event) -> Failure | None:
    """Train and evaluate one job.

    Args:
        conditions: the conditions of the comparison.
        device: value of CUDA_VISIBLE_DEVICES, or None to leave it unchanged.
        stopped: set if the job is to end early.

    Returns:
        The failure, or None if the job succeeded.
    """
    job.log.parent.mkdir(parents=True, exist_ok=True)
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    if device is not None:
        environment["CUDA_VISIBLE_DEVICES"] = device
    for command in (job.train_command(conditions), job.eval_command(conditions)):
        code = _run(command, job, environment, stopped)
        if code != 0 or stopped.is_set():
            return Failure(_reason(code, job.log), job.log)
    if not is_done(job):
        return Failure("it ended without a result", job.log)
    return None


def _run(command: list[str], job: Job, environment: dict[str, str], stopped: threading.Event) -> int:
    """Run a command and return its exit status. Output goes to the job's log, and its last line to the terminal."""
    with job.log.open("ab") as log:
        log.write(("$ " + " ".join(command) + "\n").encode())
        log.flush()
        # In its own session, so that Ctrl-C reaches it only once, from this process.
        process = subprocess.Popen(command, stdout=log, stderr=log, env=environment, start_new_session=True)
        # The terminal can show only one status, so parallel runs have none.
        alone = console.is_terminal and "CUDA_VISIBLE_DEVICES" not in environment
        with Status(job.title, console=console) if alone else nullcontext() as status:
            while True:
                try:
                    return process.wait(timeout=LOOK_EVERY)
                except subprocess.TimeoutExpired:
                    if status is not None:
                        status.update(f"{job.title}: {last_line(job.log)}")
                if stopped.is_set():
                    return _end(process)


def _end(process: subprocess.Popen[bytes]) -> int:
    """Terminate a run after it has saved."""
    process.terminate()
    try:
        return process.wait(timeout=GRACE)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()


def last_line(log: Path) -> str:
    """Return the last non-empty line of the file `log`."""
    with log.open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(size - 4096, 0))
        lines = file.read().decode("utf-8", errors="replace").replace("\r", "\n").splitlines()
    return next((line.strip() for line in reversed(lines) if line.strip()), "")


def _reason(code: int, log: Path) -> str:
    if code < 0 or code - 128 in NUMBERS:
        name = signal.Signals(-code if code < 0 else code - 128).name
        return f"ended by {name}" + (" (too little memory?)" if name == "SIGKILL" else "")
    return last_line(log).removeprefix("error: ") or f"exit status {code}"
