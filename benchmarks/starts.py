"""Seconds to a PSNR, and final PSNR, of gaussian-splatting from each kind of start.

The time includes the start itself, such as the short run of instant-ngp that finds surfaces.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from benchmarks.ablation import summary, train
from nerfloom.base.console import say
from nerfloom.base.errors import NerfloomError
from nerfloom.kernels import native
from nerfloom.training.machine import machine

STARTS: dict[str, list[str]] = {
    "field": ["--start", "field"],
    "points of a reconstruction": ["--start", "points"],
    "silhouettes": ["--start", "silhouettes"],
    "random": ["--start", "random"],
}
"""Flags of ns-train for each start."""
REFUSAL = "error: --start"
"""Beginning of gaussian-splatting's error message for a start that the data does not support."""


def measure(data: Path, seconds: float, seeds: int, target: float) -> dict[str, Any]:
    """Train from every start with every seed, in turns, and print a line for each run and each start.

    Args:
        data: folder of the data set.
        seconds: seconds of training of each run.
        seeds: number of runs from each start.
        target: the time to reach this PSNR is reported, dB.

    Returns:
        The machine, the arguments and a row for each start, as plain data. For a start that the data does not support,
        the row has the error message instead of results.
    """
    runs: dict[str, list[tuple[float | None, float]]] = {name: [] for name in STARTS}
    refused: dict[str, str] = {}
    for seed in range(seeds):
        for name, switches in STARTS.items():
            if name in refused:
                continue
            try:
                runs[name].append(train(data, seconds, seed, target, switches, "gaussian-splatting"))
                say(f"seed {seed}  {name}: {runs[name][-1]}")
            except NerfloomError as error:
                if REFUSAL not in str(error):  # other errors are failures, not properties of the data
                    raise
                refused[name] = str(error)
                say(f"{name}: {error}")
    rows = [
        {"start": name, "refused": refused[name]} if name in refused else {"start": name, **_without_name(name, found)}
        for name, found in runs.items()
    ]
    for row in rows:
        say(str(row))
    arguments = {"seconds": seconds, "seeds": seeds, "target, dB": target}
    return {"machine": machine(), "kernels": native.variant(), **arguments, "rows": rows}


def _without_name(name: str, found: list[tuple[float | None, float]]) -> dict[str, Any]:
    return {key: value for key, value in summary(name, found).items() if key != "variant"}
