"""Flags of commands that train by jobs: the data, the machines, and the number of jobs at a time."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from nerfloom.base.errors import FlagError

if TYPE_CHECKING:
    from nerfloom.jobs.launcher import Launcher


@dataclass(frozen=True)
class JobFlags:
    """Choose the data of jobs, where they run, and how many at a time."""

    data: Path | None = None
    """Folder of the data set. Default: the embedded scene."""
    data_flags: str = ""
    """Flags of the data format, quoted after an "=": --data-flags="--downscale-factor 2"."""
    num_threads: int | None = None
    """CPU threads of each run. Default: all cores."""
    device_type: Literal["auto", "cpu", "cuda", "mps"] = "auto"
    """Device to train on."""
    launcher: Literal["processes", "ray", "slurm"] = "processes"
    """Launcher of the jobs: processes on this machine, a Ray cluster, or a script for Slurm. All
    produce the same files."""
    jobs: int | None = None
    """Number of simultaneous jobs. Each process has one GPU, or --num-threads CPU cores. Default: 1 for processes; with
    ray and slurm, all that have room."""
    ray_address: str | None = None
    """Address of a running Ray cluster, such as 10.0.0.1:6379 or auto. Default: one is started on this machine."""

    def chosen_launcher(self, folder: Path) -> Launcher:
        """Return the launcher that the flags describe, with the jobs' files in `folder`.

        Raises:
            ConfigError: if a flag's value is invalid, or a package is missing.
        """
        if self.ray_address is not None and self.launcher != "ray":
            raise FlagError("--ray-address belongs to --launcher ray")
        if self.launcher == "ray":
            from nerfloom.jobs.ray import Ray

            return Ray(self.jobs, self.ray_address)
        if self.launcher == "slurm":
            from nerfloom.jobs.slurm import Slurm

            return Slurm(folder, self.jobs)
        from nerfloom.jobs.processes import Processes

        return Processes(1 if self.jobs is None else self.jobs)
