"""Seconds to a PSNR, and final PSNR, of instant-ngp with one process and with several on the same cores.

Several processes train with their own batches and the mean of their gradients. So the total batch is larger, unless it
is divided among them. The kinds alternate, so that a drift of the machine's speed affects all of them.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from benchmarks.children import output_of
from nerfloom.base.child import python_command
from nerfloom.base.console import say
from nerfloom.training.machine import machine

VIEWS = 4
"""Number of validation views of the learning curve."""


def measure(
    data: Path, count: int, seconds: float, seeds: int, samples: int, targets: Sequence[float]
) -> dict[str, Any]:
    """Train with one process and with several, and print a line for each run.

    Args:
        data: folder of the data set.
        count: number of processes.
        seconds: seconds of training of each run.
        seeds: number of runs of each kind.
        samples: samples per training step of one process.
        targets: the times to reach these PSNRs of validation views are reported, dB.

    Returns:
        The machine, the arguments and a row for each run, as plain data.
    """
    kinds = {
        "one process": (1, samples),
        f"{count} processes, each with such a batch": (count, samples),
        f"{count} processes, which divide the batch": (count, samples // count),
    }
    rows = []
    for seed in range(seeds):
        for name, (processes, batch) in kinds.items():
            row = {"kind": name, "seed": seed, **trained(data, processes, seconds, seed, batch, targets)}
            say(str({key: value for key, value in row.items() if key != "curve"}))
            rows.append(row)
    arguments = {"processes": count, "seconds": seconds, "samples a step": samples, "test views": VIEWS}
    return {"machine": machine(), **arguments, "runs": rows}


def trained(
    data: Path, processes: int, seconds: float, seed: int, samples: int, targets: Sequence[float]
) -> dict[str, Any]:
    """Train once in some `processes`, by torchrun if several, with a `seed`, and return the learning curve and results.

    `data`, `seconds`, `samples` and `targets` are as in `measure`.
    """
    flags = ("instant-ngp", "--data", data, "--max-seconds", seconds)
    command = python_command("nerfloom.cli.train", *flags)
    if processes > 1:
        launch = ("--standalone", "--nproc-per-node", processes, "-m", "nerfloom.cli.train")
        command = python_command("torch.distributed.run", *launch, *flags)
    with tempfile.TemporaryDirectory() as folder:
        command += ["--machine.seed", str(seed), "--samples-per-batch", str(samples), "--vis", "none"]
        command += ["--eval", "all", "--max-eval-images", str(VIEWS)]
        output_of([*command, "--output-dir", folder])
        run = next(Path(folder).rglob("config.yml")).parent
        points = json.loads((run / "learning_curve.json").read_text())
        curve = [(round(point["seconds"], 1), round(point["psnr"], 2)) for point in points]
        summary = json.loads((run / "summary.json").read_text())
        times = {f"seconds to {target:g} dB": crossing([(0.0, 0.0), *curve], target) for target in targets}
        final = json.loads((run / "eval.json").read_text())["results"]["psnr"]
        return {
            "steps": summary["steps"],
            "rays": summary["rays"],
            **times,
            "PSNR of test views, dB": final,
            "curve": curve,
        }


def crossing(curve: Sequence[tuple[float, float]], target: float) -> float | None:
    """Return the time when a `curve` of (seconds, PSNR) first reaches a `target`, seconds; None if it does not.

    Between its points the curve is linear.
    """
    for (t0, p0), (t1, p1) in pairwise(curve):
        if p1 >= target > p0:
            return t0 + (t1 - t0) * (target - p0) / (p1 - p0)
    return None
