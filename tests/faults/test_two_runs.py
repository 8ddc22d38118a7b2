"""Two processes and one run's folder: the second is refused in every case; a dead one is in nobody's way."""

import errno
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from nerfloom.base.errors import ConfigError
from nerfloom.cli.session import start as start_session
from nerfloom.cli.train import main
from nerfloom.training.lock import LOCK, sole_user
from tests.conftest import Refused
from tests.faults.runs import ROOT, ended, new_run, start, wait_for_checkpoint
from tests.training.helpers import tiny_run, tiny_trainer

pytest.importorskip("fcntl")
HOLD = """
import signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)  # which a shell ignores in the background
from pathlib import Path
from nerfloom.training.lock import sole_user
with sole_user(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(600)
"""


def holder(folder: Path) -> subprocess.Popen[str]:
    """A process that holds a folder."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(folder)], env=environment, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    return process


def test_the_second_is_refused_and_told_who_was_first(tmp_path: Path) -> None:
    first = holder(tmp_path / "run")
    try:
        words = f"run is in use by process {first.pid} on .*; wait until it has ended"
        with pytest.raises(ConfigError, match=words), sole_user(tmp_path / "run"):
            pytest.fail("both hold it")
        with sole_user(tmp_path / "another"):
            pass
    finally:
        first.kill()
        first.wait()


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_a_lock_dies_with_its_process(number: signal.Signals, tmp_path: Path) -> None:
    first = holder(tmp_path / "run")
    first.send_signal(number)
    first.wait()
    assert (tmp_path / "run" / LOCK).is_file()
    with sole_user(tmp_path / "run"):
        assert f"process {os.getpid()} on " in (tmp_path / "run" / LOCK).read_text()
    with sole_user(tmp_path / "run"):  # and is given back
        pass


def test_an_error_gives_the_folder_back(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), sole_user(tmp_path):
        raise ZeroDivisionError
    with sole_user(tmp_path):
        pass


def test_nothing_is_written_through_a_link(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "precious").write_text("precious")
    (tmp_path / "run" / LOCK).symlink_to(tmp_path / "precious")
    with pytest.raises(ConfigError, match="cannot write the run's folder"), sole_user(tmp_path / "run"):
        pass
    assert (tmp_path / "precious").read_text() == "precious"


def test_a_file_system_without_locks_is_no_obstacle(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def none(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr("fcntl.flock", none)
    with sole_user(tmp_path):
        (tmp_path / LOCK).write_text("the first")
        with sole_user(tmp_path):  # not refused, and it says who it is
            assert (tmp_path / LOCK).read_text().startswith(f"process {os.getpid()} on ")


def test_a_run_that_goes_on_elsewhere_cannot_be_resumed(shared_tiny: Path, tmp_path: Path, refused: Refused) -> None:
    folder = tmp_path / "run"
    tiny_trainer("instant-ngp", shared_tiny, folder, max_num_iterations=2, max_eval_images=0).train()
    before = sorted(path.name for path in (folder / "nerfstudio_models").iterdir())
    with sole_user(folder):
        said = refused(main, "--resume", folder, "--max-num-iterations", 9)
    assert f"{folder} is in use by process {os.getpid()}" in said
    assert sorted(path.name for path in (folder / "nerfstudio_models").iterdir()) == before


def test_a_new_run_in_a_folder_that_is_held_is_refused(shared_tiny: Path, tmp_path: Path) -> None:
    run = tiny_run("instant-ngp", shared_tiny, tmp_path / "run")
    with sole_user(run.folder), pytest.raises(ConfigError, match=f"run is in use by process {os.getpid()} "):
        start_session(run)
    assert [path.name for path in run.folder.iterdir()] == [LOCK]


@pytest.mark.slow
def test_two_that_begin_at_once(shared_tiny: Path, tmp_path: Path) -> None:
    """One trains; the other says why it does not, and touches nothing."""
    flags, folder = new_run(shared_tiny, tmp_path, 40)
    both = [start(*flags) for _ in range(2)]
    said = [ended(process) for process in both]
    assert sorted(process.returncode for process in both) == [0, 1], said
    refusal = next(text for text, process in zip(said, both, strict=True) if process.returncode == 1)
    last = refusal.strip().splitlines()[-1]
    assert last.startswith("error: ")
    assert f"{folder} is in use by process " in last or f"{folder} already holds a run" in last
    assert (folder / "nerfstudio_models" / "step-000000040.ckpt").is_file()


@pytest.mark.slow
def test_a_killed_run_is_resumed_at_once(shared_tiny: Path, tmp_path: Path) -> None:
    flags, folder = new_run(shared_tiny, tmp_path, 100_000)
    first = start(*flags)
    wait_for_checkpoint(first, folder)
    first.kill()
    second = start("--resume", folder, "--max-num-iterations", 1)
    ended(first)
    said = ended(second)
    assert (first.returncode, second.returncode) == (-signal.SIGKILL, 0), said
    assert "resuming" in said
