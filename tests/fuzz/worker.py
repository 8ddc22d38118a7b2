"""The process that reads damaged inputs, one after the other, and writes down the outcome of each.

It may die: its last line then names the input (`campaign`).
"""

import importlib
import json
import os
import shutil
import sys
import time
import traceback
from dataclasses import asdict, dataclass
from itertools import count
from pathlib import Path
from typing import TextIO

from nerfloom.base.errors import NerfloomError
from tests.fuzz.files import Files, read_files, write_files
from tests.fuzz.mutations import damaged
from tests.fuzz.outcome import Outcome
from tests.fuzz.payload import PROOF
from tests.fuzz.reader import Reader
from tests.fuzz.sandbox import Watch, limit_files, limit_memory, within


@dataclass(frozen=True)
class Task:
    """The task of a worker."""

    module: str
    """Has `READERS`."""
    readers: list[str]
    base: str
    """A folder for all that is written."""
    report: str
    """The file that outcomes are added to, a line each, before and after."""
    first_seed: int
    start: int
    """The first input; they are counted seed by seed, through all readers."""
    stop: int | None
    """The first that is not read any more."""
    seconds: float | None
    """Seconds until the last input may begin."""
    patience: float = 20.0
    """Seconds for an input."""
    memory: int = 2**31
    """Maximum memory beyond the memory for undamaged input, bytes."""
    file_size: int = 2**26
    """Bytes of a file."""


class Place:
    """The folders that readers live in."""

    def __init__(self, base: Path) -> None:
        self.data, self.scratch, self.outside = base / "data", base / "scratch", base / "outside"
        self.here, self.temporary = base / "here", base / "temporary"
        for folder in (self.outside, self.here):
            folder.mkdir(parents=True, exist_ok=True)
        (self.outside / "secret").write_text("nobody reads this, and nobody writes here")
        os.chdir(self.here)

    def fill(self, files: Files) -> None:
        """Make the data folder anew, and the one that readers may write to empty."""
        for folder in (self.data, self.scratch):
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
        write_files(self.data, files)

    def untouched(self) -> tuple[Files, list[str]]:
        """The files that must be the same afterwards."""
        return read_files(self.outside), sorted(os.listdir(self.here))


def built(reader: Reader, folder: Path) -> Files:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    reader.build(folder)
    return read_files(folder)


def ran_out_of_memory(error: BaseException | None) -> bool:
    """Whether an input was refused only because there was no more memory: a larger machine would have given it."""
    while error is not None:
        if isinstance(error, MemoryError) or "allocate" in str(error):  # of numpy and torch
            return True
        error = error.__cause__ or error.__context__
    return False


def attempt(name: str, reader: Reader, seed: int, files: Files, place: Place, watch: Watch, patience: float) -> Outcome:
    """Damage, write and read an input."""
    error: BaseException | None = None
    with within(patience):
        files, damage = damaged(f"{name} {seed}", files, reader.targets, reader.words)
        place.fill(files)
        before = place.untouched()
        with watch.watching() as notes:
            try:
                reader.read(place.data, place.scratch)
            except KeyboardInterrupt:
                raise
            except BaseException as raised:
                error = raised
    kind, what, message, trace = "accepted", "", "", ""
    if error is not None:
        kind, what, message = "refused", type(error).__name__, str(error)
    if error is not None and not isinstance(error, NerfloomError):
        kind, trace = "escaped", "".join(traceback.format_exception(error, limit=-8))
    elif not message.isprintable():
        kind, message = "escaped", f"a message of several lines, or of commands: {message!r}"
    elif ran_out_of_memory(error):
        kind, message = "escaped", f"it asked for more memory than it may have: {message}"
    if notes or place.untouched() != before:
        kind, message = "escaped", f"it did what it may not: {'; '.join(notes) or 'it changed files elsewhere'}"
        (place.here / PROOF).unlink(missing_ok=True)
    return Outcome(name, seed, kind, what, message, tuple(damage), trace)


def work(task: Task, report: TextIO) -> None:
    """Read inputs until there are none left, or no time is."""
    readers: dict[str, Reader] = importlib.import_module(task.module).READERS
    base, place = Path(task.base), Place(Path(task.base))
    watch = Watch([place.scratch, place.temporary])
    first = {readers[name].build: name for name in reversed(task.readers)}  # some read what others do
    made = {name: built(readers[name], base / "pristine" / name) for name in first.values()}
    pristine = {name: made[first[readers[name].build]] for name in task.readers}
    for name in task.readers:  # what is not damaged is taken; and what is loaded late is loaded now
        place.fill(pristine[name])
        readers[name].read(place.data, place.scratch)
    limit_memory(task.memory)
    limit_files(task.file_size)
    begun = time.monotonic()
    for index in count(task.start):
        if index == task.stop or (task.seconds is not None and time.monotonic() - begun >= task.seconds):
            print(json.dumps({"ended": True}), file=report, flush=True)
            return
        turn, which = divmod(index, len(task.readers))
        name, seed = task.readers[which], task.first_seed + turn
        print(json.dumps({"index": index, "reader": name, "seed": seed}), file=report, flush=True)
        outcome = attempt(name, readers[name], seed, pristine[name], place, watch, task.patience)
        print(json.dumps({"index": index, "outcome": asdict(outcome)}), file=report, flush=True)


if __name__ == "__main__":
    given = Task(**json.loads(sys.argv[1]))
    with open(given.report, "a", encoding="utf-8") as lines:
        work(given, lines)
