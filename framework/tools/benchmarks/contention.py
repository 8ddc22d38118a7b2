"""Speed of training and rendering beside other programs.

instant-ngp runs alone, beside busy loops of several kinds, and beside itself. Reported is what share of its speed alone
is left, and what share of the cores would be fair: a share above the fair one means that the loops got less than
theirs. Nothing else should run meanwhile.
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
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from framework.base.child import python_command
from framework.base.console import say
from framework.base.errors import ConfigError, NerfloomError
from framework.data.data_folder import find_data
from framework.evaluation.evaluator import evaluation_background
from framework.kernels import native
from framework.tools.benchmarks.workload import endless_trainer
from framework.training.datasets import load_split
from framework.training.machine import machine
from framework.training.trainer import Trainer

LOOP = "import time\nend = time.monotonic() + {seconds}\nwhile time.monotonic() < end: pass"
WORK = ("training", "rendering")
SETTINGS_FOR = 45.0
"""Seconds of training for which the method chooses its settings."""
STEPS_BEFORE_RENDERING = 300


@dataclass(frozen=True)
class Row:
    """One condition."""

    name: str
    loops: int = 0
    """Busy loops beside the training, each of one thread."""
    nice: int = 0
    """Niceness of the loops."""
    own_group: bool = False
    """The loops are started from a session of their own, which the system's scheduler treats as one."""
    trainings: int = 1
    """Trainings at once."""
    environment: tuple[tuple[str, str], ...] = ()
    """Environment variables of the trainings."""

    def fair_share(self, cores: int) -> float:
        """Compute the fair share of the cores for one training with a thread on each core.

        Args:
            cores: cores of the machine.
        """
        if self.own_group:
            return 0.5
        weight = 1.0 if self.nice == 0 else 15 / 1024  # the scheduler's for nice 19
        return cores / (cores * self.trainings + self.loops * weight)


PASSIVE = (("OMP_WAIT_POLICY", "PASSIVE"),)
ALONE = Row("nothing")
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
        parts: names of conditions, or parts of names; all conditions if empty. Running alone is always measured.
        works: what is measured: training, rendering or both.
    Returns: a row for each condition, as plain data.
    Raises: ConfigError where a name is no condition's; DataError where no format recognises the data.
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
    """Select conditions by parts of their names; running alone is always among them, since shares are of its speed.

    Args:
        parts: names or parts of names; all conditions if empty.
    Raises: ConfigError where one is no part of any name.
    """
    for part in parts:
        if not any(part in row.name for row in ROWS):
            raise ConfigError(f"--rows: no condition is called '{part}'; known: {'; '.join(row.name for row in ROWS)}")
    return [row for row in ROWS if row is ALONE or not parts or any(part in row.name for part in parts)]


def beside(row: Row, work: str, data: Path, seconds: float, cores: int) -> dict[str, Any]:
    """Measure every training or rendering of a condition, each in a process of its own.

    Args:
        row: the condition.
        work: training or rendering.
        data: folder of the data set.
        seconds: seconds of the measurement.
        cores: cores of the machine.
    Returns: the fair share, and what `child` returns, as a list over the processes.
    """
    command = python_command("framework.tools.benchmarks.contention", work, data, seconds)
    environment = {**os.environ, **dict(row.environment)}
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with ExitStack() as stack:

        def started(words: list[str], **options: Any) -> subprocess.Popen[str]:
            process = stack.enter_context(subprocess.Popen(words, **options))
            stack.callback(process.kill)  # before it is waited for, whatever happens
            return process

        children = [started(command, env=environment, **pipes) for _ in range(row.trainings)]
        for process in children:
            wait_for(process, "ready")
        loop = [sys.executable, "-c", LOOP.format(seconds=20 * seconds)]  # it ends by itself should we be killed
        for _ in range(row.loops):
            started(["nice", "-n", str(row.nice), *loop], start_new_session=row.own_group)
        time.sleep(0.5)
        for process in children:
            print("go", file=process.stdin, flush=True)
        found = [json.loads(wait_for(process, "{")) for process in children]
    figures = {key: [one[key] for one in found] for key in found[0]}
    return {"beside": row.name, "fair share": round(row.fair_share(cores), 2), **figures}


def wait_for(process: subprocess.Popen[str], start: str) -> str:
    """Read a process's output up to the next line with a given beginning.

    Args:
        process: started with a pipe for its output.
        start: the beginning.
    Returns: the line.
    Raises: NerfloomError where the process ends before.
    """
    for line in process.stdout or ():
        if line.startswith(start):
            return line
    raise NerfloomError(f"a process of the benchmark ended too early, with status {process.wait()}")


def child(work: str, data: Path, seconds: float) -> dict[str, float]:
    """Train or render once a line arrives on standard input, and measure how fast that goes.

    Args:
        work: training or rendering.
        data: folder of the data set.
        seconds: seconds of the measurement.
    Returns: steps or images a second, and seconds of the first, the longest and the median one.
    """
    with tempfile.TemporaryDirectory() as folder:
        trainer = endless_trainer("instant-ngp", data, SETTINGS_FOR, Path(folder))
        once = rendering(trainer) if work == "rendering" else lambda _: trainer.train_step()
        print("ready", native.variant(), flush=True)
        sys.stdin.readline()
        first = timed(once, 0)  # of a training: with the silhouettes
        times: list[float] = []
        while sum(times) < seconds:
            times.append(timed(once, len(times) + 1))
    return {
        "a second": round(len(times) / sum(times), 3),
        "first, s": round(first, 2),
        "longest, s": round(max(times), 3),
        "median, s": round(sorted(times)[len(times) // 2], 4),
    }


def rendering(trainer: Trainer) -> Callable[[int], object]:
    """Train for a few steps, and return a function that renders a test view by its number.

    Args:
        trainer: of a run whose data has test images.
    """
    views = load_split(trainer.run, "test")
    for _ in range(STEPS_BEFORE_RENDERING):
        trainer.train_step()
    background = evaluation_background(trainer.model)
    return lambda number: trainer.model.render_view(views.view(number % len(views)), background)


def timed(function: Callable[[int], object], number: int) -> float:
    """Measure the seconds that a call takes.

    Args:
        function: what is called.
        number: its argument.
    """
    start = time.perf_counter()
    function(number)
    return time.perf_counter() - start


if __name__ == "__main__":
    print(json.dumps(child(sys.argv[1], Path(sys.argv[2]), float(sys.argv[3]))), flush=True)
