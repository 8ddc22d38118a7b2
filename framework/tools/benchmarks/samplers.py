"""An occupancy grid in nested boxes against proposals, on a capture: speed and quality after the same time."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from statistics import fmean
from typing import Any

from framework.base.child import python_command
from framework.base.console import say
from framework.kernels import native
from framework.tools.benchmarks.children import output_of
from framework.training.checkpoint import FOLDER, load_newest
from framework.training.machine import machine
from framework.training.report import SUMMARY

SAMPLERS = ("proposal", "occupancy")
"""Values of --sampler that are compared."""


def measure(
    data: Path, methods: tuple[str, ...], seconds: tuple[float, ...], seed: int, switches: tuple[str, ...]
) -> dict[str, Any]:
    """Train each method with each sampler for each time, in turns, and print a line for each run.

    Args:
        data: folder of the data set.
        methods: names of the methods.
        seconds: seconds of training of the runs.
        seed: random seed.
        switches: further flags of ns-train.

    Returns:
        The machine, the arguments and a row for each run, as plain data.
    """
    rows = []
    for limit in seconds:
        for method in methods:
            for sampler in SAMPLERS:
                row = {"method": method, "sampler": sampler, "seconds": limit}
                flags = ["--sampler", sampler, "--max-seconds", str(limit), "--machine.seed", str(seed), *switches]
                rows.append(row | trained(data, method, flags))
                say(str(rows[-1]))
    arguments = {"data": data.resolve().name, "seed": seed, "flags": list(switches)}
    return {"machine": machine(), "kernels": native.variant(), **arguments, "rows": rows}


def trained(data: Path, method: str, flags: list[str]) -> dict[str, Any]:
    """Train a method in a process of its own, and evaluate it on all held-out images.

    Args:
        data: folder of the data set.
        method: its name.
        flags: flags of ns-train.

    Returns:
        Steps, rays a second and samples a ray of training (those of the last steps, without proposals' own), and PSNR,
        SSIM, floaters where they are known, and seconds an image of the evaluation.
    """
    with tempfile.TemporaryDirectory() as folder:
        command = python_command("framework.cli.train", method, "--data", data, "--vis", "none", "--output-dir", folder)
        output_of([*command, "--max-eval-images", "0", *flags])
        run, final = next(Path(folder).rglob("config.yml")).parent, Path(folder) / "all.json"
        output_of(python_command("framework.cli.evaluate", "--load-config", run, "--output-path", final))
        summary, evaluation = (json.loads(path.read_text()) for path in (run / SUMMARY, final))
        checkpoint = load_newest(run / FOLDER)
    results = evaluation["results"]
    assert checkpoint is not None
    return {
        "steps": summary["steps"],
        "rays a second": round(summary["rays_per_second"]),
        "samples a ray": round(checkpoint["state"]["samples_per_ray"], 1),
        "parameters": summary["parameters"],
        **{name: round(results[name], 4) for name in ("psnr", "ssim", "floaters") if results.get(name) is not None},
        "images": results["num_images"],
        "seconds an image": round(fmean(image["seconds"] for image in evaluation["per_image"]), 3),
    }
