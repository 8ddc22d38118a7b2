"""Jobs by Slurm: a script for `sbatch`, with an array that has a task for each unfinished job.

The script is plain shell: a task runs a job's commands, and continues where an earlier one was stopped. Only the jobs
run on the cluster.
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from nerfloom.base.atomic import write_atomically
from nerfloom.base.console import say
from nerfloom.base.errors import ConfigError, printable
from nerfloom.jobs.job import Failure, Job, Step
from nerfloom.jobs.launcher import Launcher, Ledger, nothing

SCRIPT = "jobs.sh"
"""Name of the script."""


@dataclass(frozen=True)
class Slurm(Launcher):
    """The launcher that writes a script for Slurm, and leaves it to the user to submit.

    Args:
        folder: folder of the script, on a file system that the cluster's machines share.
        at_once: maximum number of simultaneous jobs; None for all that Slurm has room for.
    """

    folder: Path
    at_once: int | None = None

    @property
    def sharing(self) -> str | None:
        return "Slurm chose the machines, and may have run several at a time on one."

    def run(self, jobs: Sequence[Job], on_finished: Callable[[Job], None] = nothing) -> dict[Job, Failure]:
        ledger = Ledger(jobs, on_finished)
        if waiting := ledger.unfinished():
            path = self.folder / SCRIPT
            try:
                self.folder.mkdir(parents=True, exist_ok=True)
                for job in waiting:
                    job.log.parent.mkdir(parents=True, exist_ok=True)
                write_atomically(path, lambda file: file.write(os.fsencode(script(waiting, self.at_once))))
            except OSError as error:
                raise ConfigError(f"cannot write {path}: {error.strerror}") from error
            say(f"{len(waiting)} jobs are ready: sbatch {shlex.quote(str(path))} (with --time and the like before it)")
            say("then run the same command again: it takes what is finished, and writes a script for the rest")
        return ledger.failures


def script(jobs: Sequence[Job], at_once: int | None) -> str:
    """Return the script that runs `jobs` as tasks of an array, at most `at_once` at a time if not None."""
    cores, gpus = (max(getattr(job.resources, name) or 0 for job in jobs) for name in ("cores", "gpus"))
    whole = any(job.resources.cores is None for job in jobs)
    limit = "" if at_once is None else f"%{at_once}"
    lines = [
        "#!/bin/bash",
        "#SBATCH --job-name=nerfloom",
        f"#SBATCH --array=0-{len(jobs) - 1}{limit}",
        "#SBATCH --ntasks=1",
        "#SBATCH --exclusive" if whole else f"#SBATCH --cpus-per-task={cores}",
        *([f"#SBATCH --gpus-per-task={gpus}"] if gpus else []),
        "#SBATCH --requeue",
        "#SBATCH --output=/dev/null",
        "export PYTHONUNBUFFERED=1",
        'case "$SLURM_ARRAY_TASK_ID" in',
    ]
    for number, job in enumerate(jobs):
        own = job.resources.cores
        lines += [
            f"{number})  # {printable(job.title)}",
            f"  exec >> {shlex.quote(str(job.log.absolute()))} 2>&1 || exit",
            f"  cd {shlex.quote(str(Path.cwd()))} || exit",
            *([] if own is None else [f"  export OMP_NUM_THREADS={own}"]),
            *(f"  {_shell(step)} || exit" for step in job.steps),
            "  ;;",
        ]
    return "\n".join([*lines, "esac", ""])


def _shell(step: Step) -> str:
    """Return a step as a line of shell."""
    first = shlex.join(step.command)
    if step.started is None:
        return first
    return f"if [ -e {shlex.quote(str(step.started))} ]; then {shlex.join(step.resume)}; else {first}; fi"
