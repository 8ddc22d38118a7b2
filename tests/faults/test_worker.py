"""A process that COLMAP works in and that dies there: an error in one line, with the last that it said."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from nerfloom.base.errors import DataError
from nerfloom.processing.worker import Report, run_in_child
from tests.patience import PATIENCE, until

ROOT = Path(__file__).parents[2]
"""Not from tests.faults.runs: children import this file, and torch takes them seconds."""


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
        run_in_child(work, ("killed",), "Matching", 3, log)
    last = f"its last output: half of the pairs (complete: {log})"
    assert str(error.value) == f"COLMAP stopped while matching (exit status -9); {last}"


@pytest.mark.medium
def test_a_process_that_runs_out_of_memory(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"^COLMAP: MemoryError: no memory$"):
        run_in_child(work, ("out of memory",), "Matching", 3, tmp_path / "log.txt")
    assert run_in_child(work, ("none",), "Matching", 3, tmp_path / "log.txt") == 7


PARENT = """
import sys
from pathlib import Path
from nerfloom.cli.common import run_command
from nerfloom.processing.worker import run_in_child
from tests.faults.test_worker import endless

if __name__ == "__main__":
    run_command(lambda _: run_in_child(endless, (sys.argv[1],), "Matching", 3, None))
"""


def endless(report: Report, place: str) -> None:
    Path(place).write_text(str(os.getpid()))
    time.sleep(600)


def is_running(process: int) -> bool:
    try:
        return "Z" not in Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False


@pytest.mark.medium
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes in /proc")
@pytest.mark.parametrize(("number", "status"), [(signal.SIGTERM, 143), (signal.SIGKILL, -9)])
def test_it_ends_with_the_process_that_started_it(number: signal.Signals, status: int, tmp_path: Path) -> None:
    place, script = tmp_path / "worker", tmp_path / "parent.py"
    script.write_text(PARENT)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    parent = subprocess.Popen([sys.executable, str(script), str(place)], env=environment, stderr=subprocess.DEVNULL)
    until(lambda: place.exists() and place.read_text() != "")
    worker = int(place.read_text())
    assert is_running(worker)
    parent.send_signal(number)
    assert parent.wait(PATIENCE) == status
    until(lambda: not is_running(worker))
