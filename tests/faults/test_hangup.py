"""A terminal that is closed, as at the end of a connection by ssh: the run saves, and needs no terminal for it."""

import os
import signal
import sys
import time
from pathlib import Path

import pytest

pty = pytest.importorskip("pty")

SCRIPT = """
import sys, time
from pathlib import Path
from nerfloom.base.console import say
from nerfloom.base.signals import orderly_end, stop_signals

with orderly_end(), stop_signals() as received:
    Path(sys.argv[1]).touch()
    while not received:
        time.sleep(0.02)
    say("a line that no terminal takes")
    print("another", flush=True)
    Path(sys.argv[2]).touch()
"""


def run_and_close_terminal(folder: Path, ignored: bool) -> Path:
    """Run `SCRIPT` in a terminal, close this once the script waits, and return the file that it writes after a signal.

    Args:
        folder: folder of the files.
        ignored: whether the script starts with SIGHUP ignored, as under nohup.
    """
    ready, saved = folder / "ready", folder / "saved"
    child, terminal = pty.fork()
    if child == 0:
        signal.signal(signal.SIGHUP, signal.SIG_IGN if ignored else signal.SIG_DFL)  # these tests may run under nohup
        os.execv(sys.executable, [sys.executable, "-c", SCRIPT, str(ready), str(saved)])
    while not ready.exists():
        time.sleep(0.02)
    os.close(terminal)
    if ignored:
        time.sleep(0.2)
        assert not saved.exists()
        os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return saved


@pytest.mark.medium
def test_a_closed_terminal_ends_a_run_that_saves_and_nohup_prevents_it(tmp_path: Path) -> None:
    assert run_and_close_terminal(tmp_path, ignored=False).exists()
    (tmp_path / "other").mkdir()
    assert not run_and_close_terminal(tmp_path / "other", ignored=True).exists()
