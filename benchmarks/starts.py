"""Seconds to a PSNR, and final PSNR, of gaussian-splatting from each kind of start.

The time includes the start itself, such as the short run of instant-ngp that finds surfaces.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from benchmarks import ablation

STARTS: dict[str, list[str]] = {
    "field": ["--start", "field"],
    "points of a reconstruction": ["--start", "points"],
    "silhouettes": ["--start", "silhouettes"],
    "random": ["--start", "random"],
}
"""Flags of ns-train for each start."""


def measure(data: Path, seconds: float, seeds: int, target: float) -> dict[str, Any]:
    """Train from every start with every seed, in turns (`ablation.measure`).

    Args:
        data: folder of the data set.
        seconds: seconds of training of each run.
        seeds: number of runs from each start.
        target: the time to reach this PSNR is reported, dB.
    """
    return ablation.measure(data, seconds, seeds, target, STARTS, "gaussian-splatting", "start")
