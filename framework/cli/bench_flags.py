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
    """Number of runs; the report gives medians."""
    variants: tuple[str, ...] = ()
    """Instruction sets, such as avx2 avx512, each measured in its own process. Default: the fastest."""
    output_dir: Path = RESULTS
    """Folder of kernels-VARIANT.json."""
    plot_dir: Path | None = None
    """Folder for a plot of the times. Default: no plot."""


@dataclass(frozen=True)
class FramesFlags:
    """Measure colour pictures per second of runs and files on the CPU, along the cameras of held-out images."""

    runs: tuple[Path, ...] = ()
    """Run folders, scenes in blocks, and files of Gaussians, of levels or of octrees, as ns-eval takes them."""
    data: Path | None = None
    """Folder of the data of files, or of runs if it has moved."""
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
    """Folder of the data set. Default: the embedded scene."""
    max_seconds: float = 120.0
    """Seconds of training of each method."""
    repeats: int = 1
    """Number of runs of each method, with different seeds."""
    run_dir: Path | None = None
    """Folder of runs and report. Default: outputs/bench-DATA."""
    output_dir: Path = RESULTS
    """Folder of methods-DATA.json."""
    plot_dir: Path | None = None
    """Folder for a plot of PSNR over time. Default: no plot."""


@dataclass(frozen=True, kw_only=True)
class ProfileFlags:
    """Train for some steps, then measure 200: the time in each compiled kernel, and the rest."""

    data: Path
    """Folder of the data set."""
    method: str = "instant-ngp"
    """A method, optionally with flags: 'vanilla-nerf --sampler occupancy'."""
    steps: int = 900
    """Training steps before the measurement."""
    max_seconds: float = 45.0
    """Time budget for the method's choice of settings, seconds; training does not stop after it."""
    output_dir: Path = RESULTS
    """Folder of profile-step.json; a row for the method is added."""
