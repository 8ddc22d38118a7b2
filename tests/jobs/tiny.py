"""Jobs that take moments: Python programs that leave a file."""

import os
import sys
from pathlib import Path

from nerfloom.jobs.job import Job, Resources, Step


def program(code: str) -> tuple[str, ...]:
    """A command line that runs a few lines of Python."""
    return (sys.executable, "-c", f"import os, pathlib, signal, sys, time\n{code}")


def write(path: Path, text: str = "text", how: str = "w") -> str:
    """A line of Python that writes a file."""
    return f"open({str(path)!r}, {how!r}).write({text!r})"


def job(folder: Path, name: str, *steps: Step, code: str = "", cores: int | None = 1) -> Job:
    """A job that is finished when NAME.txt is there; by default it prints its name and writes that file."""
    result = folder / f"{name}.txt"
    steps = steps or (Step(program(f"print({name!r})\n{code}\n{write(result, name)}")),)
    return Job(name, "a moment", steps, folder / "logs" / f"{name}.log", result.exists, Resources(cores))


def long_job(folder: Path, name: str) -> Job:
    """A job that never ends by itself, saves when it is told to, and then can be resumed to its end."""
    begun, saved, result = (folder / f"{name}.{kind}" for kind in ("begun", "saved", "txt"))
    save = f"signal.signal(signal.SIGTERM, lambda *_: ({write(saved)}, sys.exit(143)))"
    first = program(f"{save}\n{write(begun)}\nwhile True: time.sleep(0.01)")
    again = program(f"assert os.path.exists({str(saved)!r})\n{write(result, name)}")
    return job(folder, name, Step(first, begun, again))


def files(folder: Path) -> dict[str, str]:
    """Names and contents of the results in a folder."""
    return {path.name: path.read_text() for path in sorted(folder.glob("*.txt"))}


DRIVER = """
import sys
from pathlib import Path
from tests.jobs.tiny import job, long_job
from nerfloom.cli.common import run_command
from nerfloom.cli.job_flags import JobFlags
folder, launcher, address = Path(sys.argv[1]), sys.argv[2], next(iter(sys.argv[3:]), None)
run_command(lambda _: JobFlags(launcher=launcher, ray_address=address).chosen_launcher(folder).run(
    [job(folder, "first"), long_job(folder, "second")]))
"""
"""Program with a folder, a launcher's name and perhaps Ray's address as arguments: a short job, then a long one."""


def driver(folder: Path, launcher: str, *address: str) -> tuple[list[str], dict[str, str]]:
    """The command line of `DRIVER`, and its environment."""
    root = str(Path(__file__).parents[2])
    return [sys.executable, "-c", DRIVER, str(folder), launcher, *address], {**os.environ, "PYTHONPATH": root}
