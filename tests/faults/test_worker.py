"""A process that COLMAP works in and that dies there: an error in one line, with the last that it said."""

import os
import signal
from pathlib import Path

import pytest

from framework.errors import DataError
from framework.processing.worker import Report, run_apart


def work(report: Report, fate: str) -> int:
    print("half of the pairs", flush=True)
    report(1)
    if fate == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    if fate == "out of memory":
        raise MemoryError("no memory")
    return 7


@pytest.mark.skipif(os.name != "posix", reason="needs SIGKILL")
def test_a_process_that_is_killed_at_its_work(tmp_path: Path) -> None:
    log = tmp_path / "log.txt"
    with pytest.raises(DataError) as error:
        run_apart(work, ("killed",), "Matching", 3, log)
    last = f"it said: half of the pairs (all of it: {log})"
    assert str(error.value) == f"COLMAP stopped while matching (exit status -9); {last}"


def test_a_process_that_runs_out_of_memory(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"^COLMAP: MemoryError: no memory$"):
        run_apart(work, ("out of memory",), "Matching", 3, tmp_path / "log.txt")
    assert run_apart(work, ("none",), "Matching", 3, tmp_path / "log.txt") == 7
