"""The benchmark `ns-bench processes`: its flags, and what it does with them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from nerfloom.cli.bench_results import RESULTS, write_results
from nerfloom.cli.common import make_room


@dataclass(frozen=True, kw_only=True)
class ProcessesFlags:
    """Train instant-ngp with one process and with several on the same cores; report the times to some PSNRs."""

    data: Path
    """Folder of the data set."""
    processes: int = 2
    """Number of processes."""
    seconds: float = 40.0
    """Seconds of training of each run."""
    seeds: int = 1
    """Number of runs of each kind."""
    samples: int = 2**15
    """Samples of a training step of one process."""
    targets: tuple[float, ...] = (24.0, 26.0, 28.0)
    """PSNRs of validation views, dB, to which the time is reported."""
    output_dir: Path = RESULTS
    """Folder of processes-DATA.json."""


def measure_processes(flags: ProcessesFlags) -> None:
    """Measure, and write the results.

    Args:
        flags: the flags of the command.
    """
    from nerfloom.tools.benchmarks.processes import measure

    path = flags.output_dir / f"processes-{flags.data.resolve().name}.json"
    make_room(path)
    write_results(path, measure(flags.data, flags.processes, flags.seconds, flags.seeds, flags.samples, flags.targets))
