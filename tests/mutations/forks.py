"""A process that has imported what tests need besides the tree under test, and forks one that tests it for each bug.

Importing torch and its like takes longer than most tests. Asked on standard input, a JSON object a line: pytest's
`arguments`, `environment` to add, `log` for what it prints, `patience` in seconds. Answers with its exit status, a line
each; `null` where it had to be killed.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from typing import Any

from tests.mutations.copy import Copy

PRELOADED = (
    "numpy", "torch", "torch.optim", "torch.utils.tensorboard", "scipy.stats", "scipy.spatial.transform",
    "skimage.metrics", "hypothesis", "hypothesis.strategies", "imageio.v3", "PIL.Image", "yaml", "tyro", "rich.console",
    "jinja2", "pytest",
)  # fmt: skip


class Tester:
    """Runs pytest in a copy, again and again."""

    def __init__(self, copy: Copy) -> None:
        words = [str(copy.python), "-m", "tests.mutations.forks"]
        environment = copy.environment(OMP_WAIT_POLICY="PASSIVE")
        self._process = subprocess.Popen(
            words, cwd=copy.root, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def run(self, arguments: list[str], environment: dict[str, str], log: str, patience: float) -> int | None:
        """pytest's exit status; None where it had to be killed."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        asked = {"arguments": arguments, "environment": environment, "log": log, "patience": patience}
        self._process.stdin.write(json.dumps(asked) + "\n")
        self._process.stdin.flush()
        answer: int | None = json.loads(self._process.stdout.readline())
        return answer

    def close(self) -> None:
        """No more is asked."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()


def serve() -> None:
    """Answer until there is nothing more to read."""
    for name in PRELOADED:
        with suppress(ImportError):
            __import__(name)
    for line in sys.stdin:
        asked = json.loads(line)
        child = os.fork()
        if child == 0:
            _test(asked)
        print(json.dumps(_wait(child, asked["patience"])), flush=True)


def _test(asked: dict[str, Any]) -> None:
    """Become the process that tests; never returns."""
    os.setsid()
    with open(asked["log"], "wb") as log:
        for stream in (1, 2):
            os.dup2(log.fileno(), stream)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.environ.update(asked["environment"])
    status = 3
    try:
        import pytest

        status = int(pytest.main(asked["arguments"]))
    finally:
        sys.stdout.flush()
        os._exit(status)


def _wait(child: int, patience: float) -> int | None:
    """A child's exit status; None where it was killed for it took too long, not counting when all stood still."""
    left, before = patience, time.monotonic()
    while left > 0:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.02)
        now = time.monotonic()
        left, before = left - min(now - before, 1.0), now
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return None


if __name__ == "__main__":
    serve()
