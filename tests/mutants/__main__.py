"""Plant every mutant, one at a time, and run the test that must fail for it: make mutants ONLY='WORD ...'

Each is tried in a process of its own, forked from one that has imported torch and not the package; no file of the
repository is written. Ends with status 1 if a mutant survives, or cannot be planted or tried.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import NoReturn

from tests.mutants import all_mutants
from tests.mutants.mutant import ROOT, Mutant, NotPlantable, Planter, source_of

PATIENCE = 300
"""Maximum seconds of a test, because a mutant may be an endless loop; then it counts as failed."""
PYTEST = ("-q", "-x", "--tb=short", "-p", "no:xdist", "-p", "no:cacheprovider", "--hypothesis-seed=0")
PRELOADED = (
    "torch",
    "torch.utils.tensorboard",
    "pytest",
    "hypothesis",
    "imageio.v3",
    "scipy.stats",
    "skimage.metrics",
    "tyro",
)
PASSED, FAILED, UNPLANTABLE = 0, 1, 100
"""Exit statuses: two of pytest's, and one of ours."""


@dataclass(frozen=True)
class Tried:
    """The result for a mutant, or for all tests without one."""

    mutant: Mutant | None
    status: int
    """Exit status of the process; less than 0 is the number of the signal that ended it."""
    said: str

    @property
    def verdict(self) -> str:
        """killed, survived, or why it could not be tried."""
        if self.status == PASSED:
            return "survived"
        if self.status in (FAILED, -signal.SIGALRM):
            return "killed"
        if self.status == UNPLANTABLE:
            return self.said.strip().splitlines()[-1]
        return f"its test cannot be run (status {self.status}): {self.said.strip()[-500:]}"


def main() -> int:
    """Returns: the exit status."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutants", description=__doc__)
    parser.add_argument("only", nargs="*", metavar="WORD", help="part of a mutant's name or module; all if not given")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="mutants at a time")
    parser.add_argument("--list", action="store_true", help="show the mutants, and plant none")
    flags = parser.parse_args()
    words = flags.only or [""]
    mutants = [one for one in all_mutants() if any(word in f"{one.name} {one.where}" for word in words)]
    if not mutants:
        print(f"no mutant has {' or '.join(flags.only)} in its name or module", file=sys.stderr)
        return 1
    if flags.list:
        print("\n".join(f"{one.name:34} {one.where}: {one.means}" for one in mutants))
        return 0
    preload()
    tests = sorted({one.test for one in mutants})
    print(f"{len(tests)} tests without a mutant", flush=True)
    (whole,) = tried([(None, tests)], 1)
    if whole.status != PASSED:
        print(f"they must pass:\n{whole.said}", file=sys.stderr)
        return 1
    begun, bad = time.monotonic(), []
    for done, one in enumerate(tried([(one, [one.test]) for one in mutants], flags.jobs), start=1):
        assert one.mutant is not None
        left = (time.monotonic() - begun) / done * (len(mutants) - done)
        print(f"{done:3}/{len(mutants)}, {left / 60:.1f} min left: {one.mutant.name}: {one.verdict}", flush=True)
        if one.verdict != "killed":
            bad.append(one.mutant)
    print("\n".join(f"{one.name}: {one.where}: {one.means}\n    not noticed by {one.test}" for one in bad))
    print(f"{len(mutants) - len(bad)} of {len(mutants)} killed")
    return 1 if bad else 0


def tried(asked: Sequence[tuple[Mutant | None, list[str]]], jobs: int) -> Iterator[Tried]:
    """Run tests with a mutant each, some at a time.

    Args:
        asked: mutants and their tests.
        jobs: how many are tried at a time.
    Yields: results as they come.
    """
    left, running = list(reversed(asked)), {}
    while left or running:
        while left and len(running) < jobs:
            mutant, tests = left.pop()
            log = tempfile.TemporaryFile()  # noqa: SIM115
            child = os.fork()
            if child == 0:
                _become(mutant, tests, log.fileno())
            running[child] = mutant, log
        child, status = os.wait()
        mutant, log = running.pop(child)
        log.seek(0)
        yield Tried(mutant, os.waitstatus_to_exitcode(status), log.read().decode("utf-8", "replace"))
        log.close()


def _become(mutant: Mutant | None, tests: list[str], log: int) -> NoReturn:
    """Be the process that tests; never returns."""
    os.setsid()
    for stream in (1, 2):
        os.dup2(log, stream)
    status = UNPLANTABLE
    try:
        import pytest

        if mutant is not None:
            mutant.tree(source_of(mutant.module).read_text("utf-8"))
            Planter(mutant).plant()
            signal.alarm(PATIENCE)
        status = int(pytest.main([*PYTEST, *(f"tests/{one}" for one in tests)]))
    except NotPlantable as error:
        print(error)
    finally:
        sys.stdout.flush()
        os._exit(status)


def preload() -> None:
    """Import the packages that tests need besides this one, from the repository's root."""
    os.chdir(ROOT)
    os.environ["OMP_WAIT_POLICY"] = "PASSIVE"  # read when torch loads (tests/conftest.py)
    for name in PRELOADED:
        import_module(name)


if __name__ == "__main__":
    sys.exit(main())
