"""Python programs in processes of their own that share one import of torch, which takes more than a second.

They are forked from a process that has done nothing else. So they can die, and depend on variables of the environment;
but torch's own variables, such as OpenMP's, it has read already, and programs about imports belong into a
process of their own from its start.
"""

import json
import os
import signal
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, NoReturn

from tests.patience import PATIENCE

ROOT = Path(__file__).parents[1]
Program = tuple[str, Sequence[object], dict[str, str]]
"""Code, its arguments, and variables besides this process's."""


@dataclass(frozen=True)
class Ended:
    """The end of a program."""

    returncode: int
    """As in `subprocess`: less than 0 is the number of the signal that ended it."""
    stdout: str
    stderr: str


class Forks:
    """A process that forks one for each program."""

    def __init__(self) -> None:
        words = [sys.executable, "-m", "tests.forked"]
        self._origin = subprocess.Popen(words, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def run(self, code: str, *arguments: object, **environment: str) -> Ended:
        """Run a program to its end."""
        return self.together((code, arguments, environment))[0]

    def together(self, *programs: Program) -> list[Ended]:
        """Run programs to their ends, all at once."""
        asked = [(code, [*map(str, words)], {**os.environ, **variables}) for code, words, variables in programs]
        assert self._origin.stdin is not None
        assert self._origin.stdout is not None
        self._origin.stdin.write(json.dumps(asked) + "\n")
        self._origin.stdin.flush()
        return [Ended(*found) for found in json.loads(self._origin.stdout.readline())]

    def close(self) -> None:
        """End the process, which does so when there is nothing more to read."""
        self._origin.communicate()


def _serve() -> None:
    import torch  # noqa: F401

    for line in sys.stdin:
        begun = [_begun(*asked) for asked in json.loads(line)]
        print(json.dumps([_ended(*process) for process in begun]), flush=True)


def _begun(code: str, arguments: list[str], environment: dict[str, str]) -> tuple[int, list[IO[bytes]]]:
    """A new process that runs the code: its number, and the files of its output, which `_ended` closes."""
    files: list[IO[bytes]] = [tempfile.TemporaryFile() for _ in range(2)]  # noqa: SIM115
    process = os.fork()
    if process == 0:
        _become(code, arguments, environment, files)
    return process, files


def _become(code: str, arguments: list[str], environment: dict[str, str], files: list[IO[bytes]]) -> NoReturn:
    """Run the code, and end as Python does."""
    status = 1
    try:
        for number, file in zip((1, 2), files, strict=True):
            os.dup2(file.fileno(), number)
        os.environ.clear()
        os.environ.update(environment)
        sys.argv = ["-c", *arguments]
        signal.alarm(round(PATIENCE))
        exec(compile(code, "<string>", "exec"), {"__name__": "__main__"})
        status = 0
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def _ended(process: int, files: list[IO[bytes]]) -> tuple[Any, ...]:
    """Its exit status, and its output."""
    status = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
    said = []
    for file in files:
        file.seek(0)
        said.append(file.read().decode("utf-8", "replace"))
        file.close()
    return status, *said


if __name__ == "__main__":
    _serve()
