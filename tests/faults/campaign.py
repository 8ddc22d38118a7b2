"""Faults injected into runs at random moments, and whether anything that was committed is lost by them.

A run is started, stopped, spoiled and resumed by one fault after the other; then it is let go on to its end, which must
equal an undisturbed run's, to the last bit.
"""

import json
import os
import signal
import subprocess
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from random import Random
from typing import Any

from nerfloom.training.checkpoint import FOLDER, list_checkpoints
from nerfloom.training.lock import LOCK
from tests.conftest import write_tiny
from tests.faults.inside import INJECTED
from tests.faults.runs import curve, ended, new_run, readable_steps, start, wait_for_checkpoint
from tests.patience import until
from tests.training.helpers import differences

STEPS = 160
EVALUATED = 20
"""Steps between evaluations, of one image each."""
REPORTS = ("dataparser_transforms.json", "scene_profile.json", "summary.json", "skip_report.json", "eval.json")


class Broken(Exception):
    """A condition that must hold does not."""


def require(holds: object, what: str) -> None:
    """Raises: Broken where something does not hold."""
    if not holds:
        raise Broken(what)


@dataclass(frozen=True)
class Stage:
    """A run while faults are injected into it."""

    folder: Path
    flags: tuple[object, ...]
    """ns-train's, to begin the run."""
    life: float
    """Seconds that a run takes which nothing happens to."""
    random: Random

    def start(self, world: str | None = None) -> subprocess.Popen[str]:
        """Begin the run, or go on with it."""
        begun = (self.folder / "config.yml").exists()
        return start(*(("--resume", self.folder) if begun else self.flags), world=world)

    def wait(self, process: subprocess.Popen[str]) -> None:
        """Let a process come to some moment of its life, often one soon after it has saved; or to its end."""
        if self.random.random() < 0.5:
            pause = self.random.uniform(0, self.life)
        else:
            wait_for_checkpoint(process, self.folder)
            pause = self.random.uniform(0, 0.1)
        try:
            process.wait(pause)
        except subprocess.TimeoutExpired:
            return

    def saved(self) -> set[int]:
        """The steps that there are checkpoints of, readable or not."""
        return {int(path.stem.removeprefix("step-")) for path in list_checkpoints(self.folder / FOLDER)}


Fault = Callable[[Stage], int | None]
"""Injects a fault.

Returns: the newest step that was seen to be saved before it came, -1 for none; None where there was no occasion for it.
Raises: Broken where the answer to it is wrong.
"""


def stopped(number: signal.Signals, stage: Stage, world: str | None = None) -> int | None:
    """A signal, at a random moment."""
    before = stage.saved()
    process = stage.start(world)
    stage.wait(process)
    seen = max(stage.saved() - before, default=-1)
    process.send_signal(number)
    said = ended(process)
    require(process.returncode in (0, -number), f"it ended with {process.returncode}: {said}")
    return seen if process.returncode or f"stopped by {number.name}" in said else None


def full_disk(stage: Stage) -> int | None:
    process = stage.start("full disk")
    last = ended(process).strip().rpartition("\n")[2]
    told = process.returncode == 1 and last.startswith("error: cannot write ")
    require(told, f"it ended with {process.returncode}: {last}")
    return -1


def dying_reader(stage: Stage) -> int | None:
    """The thread that reads pixels ahead."""
    process = stage.start("dying reader")
    said = ended(process)
    told = process.returncode == 0 or (process.returncode == 1 and "MemoryError: no memory" in said)
    require(told, f"it ended with {process.returncode}: {said}")
    return -1 if INJECTED in said else None


def second_process(stage: Stage) -> int | None:
    """It runs in the same folder; the first stands still meanwhile, and is killed then."""
    first = stage.start()
    until(lambda: first.poll() is not None or _held_by(stage.folder, first.pid))
    first.send_signal(signal.SIGSTOP)
    if first.poll() is not None:
        ended(first)
        return None
    before = _files(stage.folder)
    second = stage.start()
    said = ended(second)
    after = _files(stage.folder)
    first.kill()
    ended(first)
    refused = second.returncode == 1 and f"is in use by process {first.pid} " in said
    require(refused, f"the second ended with {second.returncode}: {said}")
    require(before == after, "the second changed what the first had written")
    return -1


def damaged_checkpoint(stage: Stage) -> int | None:
    """A bit of the newest one is another."""
    steps, paths = readable_steps(stage.folder), list_checkpoints(stage.folder / FOLDER)
    if len(steps) < 2 or len(steps) < len(paths):
        return None
    content = bytearray(paths[-1].read_bytes())
    content[stage.random.randrange(len(content))] ^= 1 << stage.random.randrange(8)
    paths[-1].write_bytes(content)
    require(readable_steps(stage.folder) == steps[:-1], f"{paths[-1].name} is damaged, and read nevertheless")
    return -1


def read_only_folder(stage: Stage) -> int | None:
    if os.geteuid() == 0 or not (stage.folder / "config.yml").exists():  # root may write to any folder
        return None
    stage.folder.chmod(0o555)
    try:
        process = stage.start()
        said = ended(process)
    finally:
        stage.folder.chmod(0o755)
    refused = process.returncode == 1 and f"cannot write the run's folder {stage.folder}" in said
    require(refused, f"it ended with {process.returncode}: {said}")
    return -1


FAULTS: dict[str, Fault] = {
    "SIGKILL": partial(stopped, signal.SIGKILL),
    "SIGTERM": partial(stopped, signal.SIGTERM),
    "clock jumps": partial(stopped, signal.SIGTERM, world="clock jumps"),
    "full disk": full_disk,
    "read-only folder": read_only_folder,
    "damaged checkpoint": damaged_checkpoint,
    "second process": second_process,
    "dying reader": dying_reader,
}
TAKES_ONE = "damaged checkpoint"
"""The only fault that removes a checkpoint: the newest."""
DECK = (*FAULTS, "SIGKILL", "SIGKILL", "SIGTERM")
"""Faults of a run, in an order of its own."""


@dataclass(frozen=True)
class Injected:
    """A fault, and the state after it."""

    kind: str
    committed: int
    """The newest step that had been saved, and that the fault may not take; -1 for none."""
    left: int
    """The newest step that can be read afterwards."""


@dataclass(frozen=True)
class Report:
    """The results of a campaign."""

    injected: tuple[Injected, ...]
    runs: int
    problems: tuple[str, ...]
    """One of each run that did not go, or end, as it should: with the bits of one that nothing happened to."""

    def as_plain(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "injected": len(self.injected),
            "faults": dict(Counter(fault.kind for fault in self.injected)),
            "committed_lost": sum(fault.left < fault.committed for fault in self.injected),
            "runs": self.runs,
            "runs_with_the_same_end": self.runs - len(self.problems),
            "problems": list(self.problems),
        }


def run(base: Path, count: int, seed: int = 0, faults: Mapping[str, Fault] = FAULTS) -> Report:
    """Inject a number of faults, one after the other; fewer where runs give no occasion, or break.

    Args:
        base: a folder for all files.
        seed: of the moments and the order; how far a run has come at a moment depends on the machine.
        faults: by name; faults in `DECK` occur as often as they are there.
    """
    random, data = Random(seed), write_tiny(base / "ball")
    begun = time.monotonic()
    whole = _undisturbed(data, base / "whole")
    life = time.monotonic() - begun
    injected: list[Injected] = []
    problems: list[str] = []
    runs = 0
    while len(injected) < count and runs < count:
        flags, folder = new_run(data, base / f"run-{runs}", STEPS, EVALUATED)
        # Pixels in a file, for a thread to read; the undisturbed run has them in memory.
        stage = Stage(folder, (*flags, "--cache-limit", 0.0, "--cache-dir", base / f"cache-{runs}"), life, random)
        runs += 1
        try:
            for fault in islice(_disturbed(stage, faults, curve(whole)), count - len(injected)):
                injected.append(fault)
                require(fault.left >= fault.committed, f"what was committed is lost: {fault}")
            _let_end(stage, whole)
        except (Broken, AssertionError, OSError, ValueError) as problem:
            problems.append(f"run {runs}: {type(problem).__name__}: {problem}")
    return Report(tuple(injected), runs, tuple(problems))


def _undisturbed(data: Path, output: Path) -> Path:
    """The folder of a run that nothing happens to."""
    flags, folder = new_run(data, output, STEPS, EVALUATED)
    process = start(*flags)
    said = ended(process)
    if process.returncode or [step for step, _ in curve(folder)] != list(range(EVALUATED, STEPS + 1, EVALUATED)):
        raise RuntimeError(f"a run does not even work undisturbed: {said}")
    return folder


def _disturbed(stage: Stage, faults: Mapping[str, Fault], truth: list[tuple[int, float]]) -> Iterator[Injected]:
    """Inject faults into a run, each once or as often as it is in `DECK`.

    Args:
        truth: the learning curve of an undisturbed run. Yields: the faults that found an occasion. Raises: Broken if
    the answer to one is wrong.
    """
    deck = [name for name in DECK if name in faults] + [name for name in faults if name not in DECK]
    for name in stage.random.sample(deck, len(deck)):
        steps = readable_steps(stage.folder)
        try:
            seen = faults[name](stage)
        except Broken as problem:
            raise Broken(f"{name}: {problem}") from problem
        if seen is None:
            continue
        found = curve(stage.folder)
        require(found == truth[: len(found)], f"{name}: the learning curve is {found}, not {truth}")
        committed = max([seen, *(steps[:-1] if name == TAKES_ONE else steps)])
        yield Injected(name, committed, max(readable_steps(stage.folder), default=-1))


def _let_end(stage: Stage, whole: Path) -> None:
    """Raises: Broken where a run does not end as one that nothing happened to."""
    process = stage.start()
    said = ended(process)
    require(process.returncode == 0, f"it does not come to its end: {said}")
    require(curve(stage.folder) == curve(whole), f"the learning curve ends as {curve(stage.folder)}")
    different = differences(whole, stage.folder)
    require(not different, f"it ends with other bits in {', '.join(different[:5])}")
    for name in REPORTS:
        json.loads((stage.folder / name).read_text())


def _held_by(folder: Path, process: int) -> bool:
    try:
        return (folder / LOCK).read_text().startswith(f"process {process} on ")
    except OSError:
        return False


def _files(folder: Path) -> dict[Path, tuple[int, int]]:
    """Sizes and times of change of all files."""
    return {path: (path.stat().st_size, path.stat().st_mtime_ns) for path in folder.rglob("*") if path.is_file()}
