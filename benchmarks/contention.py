"""Speed of training and rendering beside other programs.

instant-ngp runs alone, beside busy loops of several kinds, and beside itself. The results are its speed as a fraction
of the speed alone, and its fair share of the cores. A fraction above the fair share means that the loops got less than
theirs. No other programs should run during the measurement.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from benchmarks.children import own_command
from nerfloom.base.console import say
from nerfloom.base.errors import FlagError, NerfloomError
from nerfloom.benchmarks.profile_step import endless_trainer
from nerfloom.data.dataset import Dataset
from nerfloom.kernels import native
from nerfloom.registry import load_dataparser, load_method
from nerfloom.training.data_folder import find_data
from nerfloom.training.datasets import load_split
from nerfloom.training.machine import machine
from nerfloom.training.run import Run
from nerfloom.training.trainer import Trainer

LOOP = "import time\nend = time.monotonic() + {seconds}\nwhile time.monotonic() < end: pass"
"""Program of a busy loop."""
WORK = ("training", "rendering")
"""Kinds of work to measure."""
SETTINGS_FOR = 45.0
"""Time budget that the method's settings are chosen for, seconds."""
STEPS_BEFORE_RENDERING = 300
"""Training steps before rendering is measured."""


@dataclass(frozen=True)
class Row:
    """A condition of a measurement of speed."""

    name: str
    """Name of the condition."""
    loops: int = 0
    """Number of busy loops beside the training, each of one thread."""
    nice: int = 0
    """Niceness of the loops."""
    own_group: bool = False
    """Whether the loops have their own session, which the scheduler treats as one process."""
    trainings: int = 1
    """Number of simultaneous trainings."""
    environment: tuple[tuple[str, str], ...] = ()
    """Environment variables of the trainings."""

    def fair_share(self, cores: int) -> float:
        """Return the fair share of the machine's `cores` for one training with a thread on each core."""
        if self.own_group:
            return 0.5
        weight = 1.0 if self.nice == 0 else 15 / 1024  # the scheduler's weight for nice 19
        return cores / (cores * self.trainings + self.loops * weight)


PASSIVE = (("OMP_WAIT_POLICY", "PASSIVE"),)
ALONE = Row("nothing")
"""The condition without other programs."""
ROWS = (
    ALONE,
    Row("two loops, nice 19", loops=2, nice=19),
    Row("one loop", loops=1),
    Row("two loops", loops=2),
    Row("two loops in a session of their own", loops=2, own_group=True),
    Row("the same once more", trainings=2),
    Row("nothing, OMP_WAIT_POLICY=PASSIVE", environment=PASSIVE),
    Row("one loop, OMP_WAIT_POLICY=PASSIVE", loops=1, environment=PASSIVE),
    Row("nothing, one thread", environment=(("OMP_NUM_THREADS", "1"),)),
)


def measure(data: Path, seconds: float, parts: Sequence[str] = (), works: Sequence[str] = WORK) -> dict[str, Any]:
    """Measure training and rendering under every condition, and print a line for each.

    Args:
        data: folder of the data set.
        seconds: seconds of each measurement.
        parts: names of conditions, or parts of names; all conditions if empty. `ALONE` is always measured.
        works: work to measure: training, rendering or both.

    Returns:
        A row for each condition, as plain data.

    Raises:
        ConfigError: if no condition has such a name.
        DataError: if no format recognises the data.
    """
    find_data(data)
    rows, cores = chosen(parts), os.cpu_count() or 1
    table: dict[str, list[dict[str, Any]]] = {}
    for work in works:
        table[work] = []
        for row in rows:
            measured = beside(row, work, data, seconds, cores)
            alone = (table[work] or [measured])[0]["a second"][0]
            measured["share"] = [round(speed / alone, 2) for speed in measured["a second"]]
            table[work].append(measured)
            figures = {key: value for key, value in measured.items() if key != "beside"}
            say(f"{work:10s} {row.name:38s} {json.dumps(figures)}")
    return {"machine": machine(), "cores": cores, "seconds": seconds, **table}


def chosen(parts: Sequence[str]) -> list[Row]:
    """Return the conditions with one of `parts` in their names, or all, and `ALONE`: speeds are fractions of its speed.

    Raises:
        ConfigError: if one is not part of any name.
    """
    for part in parts:
        if not any(part in row.name for row in ROWS):
            raise FlagError(f"--rows: there is no condition '{part}'; known: {'; '.join(row.name for row in ROWS)}")
    return [row for row in ROWS if row is ALONE or not parts or any(part in row.name for part in parts)]


def beside(row: Row, work: str, data: Path, seconds: float, cores: int) -> dict[str, Any]:
    """Measure all trainings or renderings of a condition, each in its own process.

    Args:
        row: the condition.
        work: training or rendering.
        data: folder of the data set.
        seconds: seconds of the measurement.
        cores: number of cores of the machine.

    Returns:
        The fair share, and each figure of `child` as a list over the processes.
    """
    command = own_command("contention", work, data, seconds)
    environment = {**os.environ, **dict(row.environment)}
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with ExitStack() as stack:

        def started(words: list[str], **options: Any) -> subprocess.Popen[str]:
            process = stack.enter_context(subprocess.Popen(words, **options))
            stack.callback(process.kill)  # runs before the context manager waits for the process
            return process

        children = [started(command, env=environment, **pipes) for _ in range(row.trainings)]
        for process in children:
            wait_for(process, "ready")
        loop = [sys.executable, "-c", LOOP.format(seconds=20 * seconds)]  # ends by itself if this process is killed
        for _ in range(row.loops):
            started(["nice", "-n", str(row.nice), *loop], start_new_session=row.own_group)
        time.sleep(0.5)
        for process in children:
            print("go", file=process.stdin, flush=True)
        results = [json.loads(wait_for(process, "{")) for process in children]
    figures = {key: [result[key] for result in results] for key in results[0]}
    return {"beside": row.name, "fair share": round(row.fair_share(cores), 2), **figures}


def wait_for(process: subprocess.Popen[str], start: str) -> str:
    """Read the output of a `process`, a pipe, up to the next line that begins with `start`, and return this line.

    Raises:
        NerfloomError: if the process ends before that.
    """
    for line in process.stdout or ():
        if line.startswith(start):
            return line
    raise NerfloomError(f"a process of the benchmark ended too early, with status {process.wait()}")


def child(work: str, data: Path, seconds: float) -> dict[str, float]:
    """Wait for a line on standard input, then do `work`, training or rendering, on `data` for `seconds`.

    Returns:
        Steps or images per second, and the seconds of the first, the longest and the median one.
    """
    with tempfile.TemporaryDirectory() as folder:
        root, name = find_data(data)
        config = replace(load_method("instant-ngp").config, data=root)
        run = Run("instant-ngp", config, name, load_dataparser(name)(), Path())
        trainer = endless_trainer(run, SETTINGS_FOR, Path(folder))
        views = load_split(run, "test") if work == "rendering" else None
        once = rendering(trainer, views) if views is not None else lambda _: trainer.train_step()
        print("ready", native.variant(), flush=True)
        sys.stdin.readline()
        first = timed(once, 0)  # the first training step includes silhouettes
        times: list[float] = []
        while sum(times) < seconds:
            times.append(timed(once, len(times) + 1))
    return {
        "a second": round(len(times) / sum(times), 3),
        "first, s": round(first, 2),
        "longest, s": round(max(times), 3),
        "median, s": round(sorted(times)[len(times) // 2], 4),
    }


def rendering(trainer: Trainer, views: Dataset) -> Callable[[int], object]:
    """Train for a few steps by `trainer`, and return a function that renders one of the test `views` by its number."""
    for _ in range(STEPS_BEFORE_RENDERING):
        trainer.train_step()
    background = trainer.model.background
    return lambda number: trainer.model.render_view(views.view(number % len(views)), background)


def timed(function: Callable[[int], object], number: int) -> float:
    """Return the seconds of a call of `function` with `number`."""
    start = time.perf_counter()
    function(number)
    return time.perf_counter() - start


if __name__ == "__main__":
    print(json.dumps(child(sys.argv[1], Path(sys.argv[2]), float(sys.argv[3]))), flush=True)
