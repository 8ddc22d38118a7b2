"""Many damaged inputs for many readers, in a process that may die of them, and is then replaced."""

import importlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

from tests.fuzz.outcome import Outcome
from tests.fuzz.worker import Task

ROOT = Path(__file__).parents[2]
MAX_DEATHS = 50
"""Maximum number of dead workers; with more, something else is wrong."""


def run(
    readers: Sequence[str],
    base: Path,
    first_seed: int = 0,
    count: int | None = None,
    seconds: float | None = None,
    module: str = "tests.fuzz.readers",
    patience: float = 20.0,
    memory: int = 2**31,
) -> list[Outcome]:
    """Read a number of inputs for each reader, or for a number of seconds in all.

    Args:
        readers: names in `READERS` of the module.
        base: a folder for all that is written.
        patience: seconds for an input.
        memory: bytes that an input may take.
    Raises: RuntimeError where the process does not come to the inputs.
    """
    base, begun = base.resolve(), time.monotonic()
    report = base / "report.jsonl"
    stop = None if count is None else count * len(readers)
    task = Task(module, list(readers), str(base), str(report), first_seed, 0, stop, seconds, patience, memory)
    (base / "temporary").mkdir(parents=True, exist_ok=True)
    report.unlink(missing_ok=True)
    for _ in range(MAX_DEATHS):
        code, said = _work(task, base)
        outcomes, unfinished, ended = read_report(report)
        if ended:
            return outcomes
        if unfinished is None:
            raise RuntimeError(f"the worker ended with {code} before its first input, or between two: {said}")
        death = Outcome(unfinished["reader"], unfinished["seed"], "escaped", _death(code), said)
        with report.open("a", encoding="utf-8") as lines:
            lines.write(json.dumps({"index": unfinished["index"], "outcome": asdict(death)}) + "\n")
        outcomes.append(death)
        left = None if seconds is None else seconds - (time.monotonic() - begun)
        task = replace(task, start=unfinished["index"] + 1, seconds=left)
        if task.start == task.stop or (left is not None and left <= 0):
            return outcomes
    raise RuntimeError(f"{MAX_DEATHS} inputs killed the worker, the last: {outcomes[-1]}")


def names(module: str = "tests.fuzz.readers") -> list[str]:
    """The readers of a module."""
    return list(importlib.import_module(module).READERS)


def _work(task: Task, base: Path) -> tuple[int, str]:
    """Run a worker to its end. Returns: its exit status, and the end of its output."""
    environment = {
        **os.environ,
        "PYTHONDONTWRITEBYTECODE": "1",
        "PYTHONPATH": os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")])),
        "MALLOC_ARENA_MAX": "2",  # threads reserve more of the address space than they use
        "TMPDIR": str(base / "temporary"),
        "HOME": str(base / "home"),
        "NERFLOOM_CACHE": str(base / "cache"),
    }
    with (base / "said.txt").open("w+b") as said:
        command = [sys.executable, "-m", "tests.fuzz.worker", json.dumps(asdict(task))]
        code = subprocess.run(command, env=environment, stdout=said, stderr=said, cwd=base, check=False).returncode
        said.seek(max(said.seek(0, os.SEEK_END) - 2000, 0))
        return code, said.read().decode("utf-8", "replace")


def read_report(report: Path) -> tuple[list[Outcome], dict | None, bool]:
    """The outcomes of inputs; the last input that was begun, if it has no outcome; whether there are no more."""
    outcomes, begun, ended = [], None, False
    for line in report.read_text(encoding="utf-8").splitlines() if report.exists() else ():
        entry = json.loads(line)
        if "outcome" in entry:
            found = entry["outcome"]
            outcomes.append(Outcome(**{**found, "damage": tuple(found["damage"])}))
            begun = None
        elif "ended" in entry:
            ended = True
        else:
            begun = entry
    return outcomes, begun, ended


def _death(code: int) -> str:
    if code >= 0:
        return f"ended the process with {code}"
    name = signal.Signals(-code).name
    return f"killed the process by {name}" + (": it took too long" if name == "SIGALRM" else "")
