"""The flags of `ns-bench`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from nerfloom.cli.bench_results import RESULTS


@dataclass(frozen=True)
class KernelFlags:
    """Measure time per sample and error of each compiled kernel against its torch reference, in alternating runs."""

    samples: int = 2**15
    """Number of samples in a batch."""
    repeats: int = 9
    """Number of runs, of which medians are reported."""
    variants: tuple[str, ...] = ()
    """Instruction sets, each measured in its own process, such as avx2 avx512; the fastest if not given."""
    output_dir: Path = RESULTS
    """Folder of kernels-VARIANT.json."""
    plot_dir: Path | None = None
    """Folder of a plot of the times; no plot if not given."""


@dataclass(frozen=True)
class FramesFlags:
    """Measure pictures a second of trained runs on the CPU, in colour, along the cameras of held-out images."""

    runs: tuple[Path, ...] = ()
    """Folders of trained runs."""
    widths: tuple[int, ...] = (400, 540, 1080)
    """Widths of the pictures, pixels; heights follow from the cameras."""
    threads: tuple[int, ...] = (1, 2)
    """Numbers of CPU threads."""
    pictures: int = 60
    """Number of pictures at each size."""
    output: Path = RESULTS / "frames.json"
    """File of the results."""


@dataclass(frozen=True)
class MethodFlags:
    """Train every built-in method on one data set for the same time and compare them, as ns-compare does."""

    data: Path | None = None
    """Folder of the data set; the embedded scene if not given."""
    max_seconds: float = 120.0
    """Seconds of training of each method."""
    repeats: int = 1
    """Number of runs of each method, with different seeds."""
    run_dir: Path | None = None
    """Folder of runs and report; outputs/bench-DATA if not given."""
    output_dir: Path = RESULTS
    """Folder of methods-DATA.json."""
    plot_dir: Path | None = None
    """Folder of a plot of PSNR over time; no plot if not given."""


@dataclass(frozen=True, kw_only=True)
class ProfileFlags:
    """Train for some steps, then measure 200: the time in each compiled kernel, and the rest."""

    data: Path
    """Folder of the data set."""
    method: str = "instant-ngp"
    """A method, with its flags if it has some: 'vanilla-nerf --sampler occupancy'."""
    steps: int = 900
    """Training steps before the measurement."""
    max_seconds: float = 45.0
    """Time budget, seconds, for which the method chooses its settings; training does not stop after it."""
    output_dir: Path = RESULTS
    """Folder of profile-step.json, which gets a row for the method."""
