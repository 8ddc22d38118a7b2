"""Effect of each part of instant-ngp: training with one part switched off, or on, in turn.

Each variant is trained with each seed. The variants alternate, so that a drift of the machine's speed affects all of
them. The results are the training seconds to the target PSNR on validation views, and the final PSNR on all test views:
means over seeds, with the standard deviation of a single run.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Mapping, Sequence
from itertools import pairwise, product
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

from benchmarks.children import output_of
from nerfloom.base.child import python_command
from nerfloom.base.console import say
from nerfloom.base.errors import NerfloomError
from nerfloom.kernels import native
from nerfloom.training.machine import machine

VARIANTS: dict[str, list[str]] = {
    "as it is": [],
    "no visual hull (cells and pixels)": ["--silhouette-cells", "False"],
    "pixels that see background alone are drawn": ["--silhouette-pixels", "False"],
    "hidden samples evaluated": ["--train-early-stop", "0"],
    "early stop in training at 1e-4": ["--train-early-stop", "1e-4"],
    "sparse updates of the tables": ["--sparse-updates", "True"],
    "dense updates of the tables": ["--sparse-updates", "False"],
    "finest level not by the images' size, but 2048": ["--max-resolution", "2048"],
    "no view dependence": ["--view-dependence", "False"],
    "one ray a pixel": ["--rays-per-pixel", "1"],
}
"""Flags of ns-train for each variant."""
VIEWS = 4
"""Number of validation views of the learning curve."""
CURVE_POINTS = 9
"""Number of evaluations of those views during a run."""


def measure(
    data: Path,
    seconds: float,
    seeds: int,
    target: float,
    variants: Mapping[str, Sequence[str]] = VARIANTS,
    method: str = "instant-ngp",
    kind: str = "variant",
) -> dict[str, Any]:
    """Train every variant with every seed, and print a line for each run and each variant.

    Args:
        data: folder of the data set.
        seconds: seconds of training of each run.
        seeds: number of runs of each variant.
        target: the time to reach this PSNR is reported, dB.
        variants: flags of ns-train for each variant.
        method: name of the method.
        kind: name of the variants in the results. If the method refuses the flag of this name, since the data
            does not support it, the variant's row has the error message instead of results.

    Returns:
        The machine, the arguments and a row for each variant, as plain data.
    """
    runs: dict[str, list[tuple[float | None, float]]] = {name: [] for name in variants}
    refused: dict[str, str] = {}
    for seed, (name, switches) in product(range(seeds), variants.items()):
        if name in refused:
            continue
        try:
            runs[name].append(train(data, seconds, seed, target, switches, method))
            say(f"seed {seed}  {name}: {runs[name][-1]}")
        except NerfloomError as error:
            if f"error: --{kind}" not in str(error):  # other errors are failures, not properties of the data
                raise
            refused[name] = str(error)
            say(f"{name}: {error}")
    rows = [{kind: n, **({"refused": refused[n]} if n in refused else summary(found))} for n, found in runs.items()]
    for row in rows:
        say(str(row))
    arguments = {"seconds": seconds, "seeds": seeds, "target, dB": target}
    return {"machine": machine(), "kernels": native.variant(), **arguments, "rows": rows}


def train(
    data: Path, seconds: float, seed: int, target: float, switches: Sequence[str], method: str = "instant-ngp"
) -> tuple[float | None, float]:
    """Train one variant, and evaluate it on all test views.

    Args:
        data: folder of the data set.
        seconds: seconds of training.
        seed: random seed.
        target: PSNR, dB.
        switches: flags of ns-train for the variant.
        method: name of the method.

    Returns:
        Seconds to the target, None if it was not reached, and the final PSNR, dB.
    """
    with tempfile.TemporaryDirectory() as folder:
        command = python_command("nerfloom.cli.train", method, "--data", data)
        command += ["--max-seconds", str(seconds), "--machine.seed", str(seed), "--vis", "none"]
        command += ["--seconds-per-eval-all-images", str(seconds / CURVE_POINTS), "--max-eval-images", str(VIEWS)]
        output_of([*command, "--output-dir", folder, *switches])
        config = next(Path(folder).rglob("config.yml"))
        points = [p for p in json.loads((config.parent / "learning_curve.json").read_text()) if p["full"]]
        curve = [(0.0, 0.0)] + [(p["seconds"], p["psnr"]) for p in points]
        final = Path(folder) / "all.json"
        output_of(python_command("nerfloom.cli.evaluate", "--load-config", config, "--output-path", final))
        return crossing(curve, target), json.loads(final.read_text())["results"]["psnr"]


def crossing(curve: list[tuple[float, float]], target: float) -> float | None:
    """Return the time when a curve first reaches a target, seconds, by linear interpolation.

    Args:
        curve: (seconds, PSNR) in the order of time.
        target: PSNR, dB.

    Returns:
        Seconds; None if the target is not reached.
    """
    for (t0, p0), (t1, p1) in pairwise(curve):
        if p1 >= target > p0:
            return t0 + (t1 - t0) * (target - p0) / (p1 - p0)
    return None


def summary(found: list[tuple[float | None, float]]) -> dict[str, Any]:
    """Average a variant's runs over seeds.

    Args:
        found: seconds to the target and final PSNR of each run, as from `train`.
    """
    times, psnrs = [t for t, _ in found if t is not None], [p for _, p in found]
    return {
        "seconds to the target": round(fmean(times), 1) if len(times) == len(found) else None,
        "test PSNR, dB": round(fmean(psnrs), 3),
        "standard deviation of a run, dB": round(stdev(psnrs), 3) if len(psnrs) > 1 else None,
    }
