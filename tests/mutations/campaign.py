"""Bugs planted one at a time in a copy of the tree, and which test notices each."""

from __future__ import annotations

import json
import os
import queue
import subprocess
import time
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path

from tests.mutations.bug import Bug
from tests.mutations.copy import PACKAGES, Copy, make_copy
from tests.mutations.forks import Tester
from tests.mutations.plugin import FAILED, ORDER, RECORD
from tests.mutations.reach import Reach, digests, read_record

FAST = ("-m", "not slow and not medium")
PYTEST = ("-q", "-p", "tests.mutations.plugin", "-p", "no:cacheprovider", "--hypothesis-seed=0")
FIRST = 40
"""Tests that are tried before all others: collecting the tests of a few files is soon done."""
PATIENCE = 60.0, 6.0
"""Seconds that tests may take, besides so many times what they took when they were recorded. A bug may be an endless
loop."""


class TestsFail(Exception):
    """Tests fail without any bug, or cannot be run."""


@dataclass(frozen=True)
class Result:
    """What became of a bug."""

    bug: Bug
    noticed_by: str | None
    """The first test that failed; None where all passed that could have noticed."""
    tests: int
    """That could have noticed it."""
    seconds: float


def record(copy: Copy, folder: Path, files: Sequence[str], processes: int) -> Reach:
    """Run the fast tests of `files` (all if empty) and note what each runs.

    Raises: TestsFail where one fails, or coverage.py is missing.
    """
    try:
        import coverage  # noqa: F401
    except ImportError as error:
        raise TestsFail("the tests' lines are recorded by coverage.py: pip install coverage") from error
    folder.mkdir()
    sources = "\n    ".join(str(copy.root / name) for name in PACKAGES)
    (folder / "coveragerc").write_text(f"[run]\ndata_file = {folder / 'lines'}\nsource =\n    {sources}\n")
    words = [str(copy.python), "-m", "pytest", *PYTEST, *FAST, "-n", str(processes), *files]
    done = subprocess.run(
        words, cwd=copy.root, env=copy.environment(**{RECORD: str(folder)}), capture_output=True, text=True
    )
    if done.returncode not in (0, 1):
        raise TestsFail(f"pytest ended with {done.returncode}: {done.stdout[-2000:]}{done.stderr[-2000:]}")
    reach, failed = read_record(folder, copy.root)
    if failed:  # once more alone: a test that measures time fails beside others
        alone = subprocess.run([*words[:3], *PYTEST, *failed], cwd=copy.root, env=copy.environment(), check=False)
        if alone.returncode:
            raise TestsFail(f"these fail without any bug: {', '.join(failed)}\n{done.stdout[-3000:]}")
    return reach


def updated(known: Reach | None, copy: Copy, folder: Path, processes: int, without: tuple[str, ...] = ()) -> Reach:
    """A record that has all tests as they are now: of what is known, only new and changed files are run again.

    Args:
        without: folders of tests that are left as they are known.
    Raises: TestsFail.
    """
    if known is None:
        return record(copy, folder, (), processes)
    now = digests(copy.root)
    changed = [file for file in now if Path(file).name.startswith("test_") and known.digests.get(file) != now[file]]
    gone = [file for file in known.digests if file not in now]
    reach = known.without([*changed, *gone])
    if changed:
        reach.add(record(copy, folder, changed, processes))
    reach.digests.update({file: now[file] for file in changed})
    return reach


def run(bugs: Sequence[Bug], reach: Reach, folder: Path, jobs: int, most: int | None = None) -> Iterator[Result]:
    """Plant each in turn, in as many copies as there are jobs.

    Args:
        most: tests for a bug; None for all that could notice it.
    Yields: results as they come.
    """
    free: queue.SimpleQueue[Workplace] = queue.SimpleQueue()
    places = [Workplace.of(make_copy(folder / f"copy-{index}")) for index in range(jobs)]
    for place in places:
        free.put(place)

    def try_one(bug: Bug) -> Result:
        place = free.get()
        try:
            return plant(bug, reach, place, most)
        finally:
            free.put(place)

    with ThreadPoolExecutor(jobs) as pool:
        try:
            for future in as_completed([pool.submit(try_one, bug) for bug in bugs]):
                yield future.result()
        finally:
            pool.shutdown(cancel_futures=True)
            for place in places:
                place.tester.close()


@dataclass(frozen=True)
class Workplace:
    """A copy that bugs are planted in, and what runs its tests."""

    copy: Copy
    tester: Tester

    @classmethod
    def of(cls, copy: Copy) -> Workplace:
        """With a tester of its own."""
        return cls(copy, Tester(copy))


def plant(bug: Bug, reach: Reach, place: Workplace, most: int | None = None) -> Result:
    """Plant one, and run the tests that could notice it until one fails."""
    begun, root = time.monotonic(), place.copy.root
    tests = reach.tests(bug, root)[:most]
    noticed = None
    with bug.planted(root):
        for part in (tests[:FIRST], tests[FIRST:]):
            noticed = noticed or first_failure(part, reach, place)
    return Result(bug, noticed, len(tests), time.monotonic() - begun)


def first_failure(tests: Sequence[str], reach: Reach, place: Workplace) -> str | None:
    """The first of some tests that fails, run in their order.

    Raises: TestsFail where pytest itself does.
    """
    if not tests:
        return None
    folder = place.copy.root.parent
    order, failed, log = folder / "order.json", folder / "failed", folder / "log"
    order.write_text(json.dumps(list(tests)))
    failed.unlink(missing_ok=True)
    files = dict.fromkeys(name.partition("::")[0] for name in tests)
    patience = PATIENCE[0] + PATIENCE[1] * sum(reach.seconds[name] for name in tests)
    arguments = [*PYTEST, *FAST, "-x", "-p", "no:xdist", "--tb=short", *files]
    status = place.tester.run(arguments, {ORDER: str(order), FAILED: str(failed)}, str(log), patience)
    if status is None:
        return f"no end after {patience:.0f} s"
    if failed.exists():
        return failed.read_text().splitlines()[0]
    said = log.read_text(errors="replace")
    if status != 0 and (errors := [line for line in said.splitlines() if line.startswith("ERROR ")]):
        return errors[0].removeprefix("ERROR ").partition(" - ")[0]  # its module cannot even be imported
    if status < 0:
        return f"ended by signal {-status}"
    if status != 0:
        raise TestsFail(f"pytest ended with {status}: {said[-2000:]}")
    return None


def confirm(results: Iterable[Result], reach: Reach, copy: Copy) -> str | None:
    """A test that noticed a bug, and fails without any, too; None if there is none."""
    found = {result.noticed_by for result in results}
    place = Workplace.of(copy)
    try:
        return first_failure([name for name in reach.seconds if name in found], reach, place)
    finally:
        place.tester.close()


def default_jobs() -> int:
    """Half of the cores: each test uses two threads."""
    return max((os.cpu_count() or 2) // 2, 1)
