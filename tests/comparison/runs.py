"""Finished runs, made up."""

import json
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from nerfloom.comparison.plan import Conditions, Contender, Plan, PlannedRun
from nerfloom.evaluation.images import write_image
from nerfloom.jobs.job import Failure, Job
from nerfloom.jobs.launcher import Ledger, nothing

CONDITIONS = Conditions(None, (), 60.0, None, None, None, "cpu", 4, None)
MACHINE = {"processor": "abacus", "threads": 2, "kernels": "avx2", "commit": None}


def plan(folder: Path, *labels: str, repeats: int = 1) -> Plan:
    """A comparison of methods on the embedded scene."""
    return Plan(tuple(Contender.of(label) for label in labels), CONDITIONS, repeats, folder)


def finish(planned: PlannedRun, psnr: float, seconds: float = 60.0, **changes: Any) -> None:
    """Write the files of a finished run."""
    planned.folder.mkdir(parents=True)
    summary = {
        "method": planned.contender.method,
        "stopped": "60 s of training spent",
        "interrupted": False,
        "steps": 1000,
        "seconds": seconds,
        "rays": 1_000_000,
        "rays_per_second": 1_000_000 / seconds,
        "skipped_steps": 0,
        "peak_memory_bytes": 2**30,
        "parameters": 12345,
        "machine": MACHINE,
    }
    results = {"psnr": psnr, "ssim": 0.9, "lpips": None, "fps": 4.0, "num_images": 16, "num_rays_per_sec": 1e6}
    evaluation = {"results": results, "lpips": "absent: pip install it", "per_image": []}
    points = [
        {"seconds": s, "step": int(s), "psnr": psnr - 4 + s / 15, "full": full}
        for s, full in ((7.0, False), (15.0, True), (30.0, True), (45.0, True), (50.0, False), (60.0, True))
    ]
    decisions = [{"option": "background", "choice": "random", "reason": "there is <alpha>"}]
    for name, content in (
        ("summary.json", {**summary, **changes}),
        ("eval_all.json", evaluation),
        ("learning_curve.json", points),
        ("scene_profile.json", {"decisions": decisions}),
        ("skip_report.json", [{"name": "cells", "skipped": 0.5, "rendering_saved": None, "switch": "--x"}]),
    ):
        (planned.folder / name).write_text(json.dumps(content))


def at_once(outcome: Callable[[PlannedRun, float], str | None]) -> Callable[..., dict[Job, Failure]]:
    """A launcher's `run` with jobs that end at once.

    Args:
        outcome: makes the files of a run, given its seconds of training; returns the reason of a failure, or None.
    """

    def run(_: object, jobs: Sequence[Job], on_finished: Callable[[Job], None] = nothing) -> dict[Job, Failure]:
        ledger = Ledger(jobs, on_finished)
        for job in ledger.unfinished():
            words = job.steps[0].command
            assert isinstance(job.finished, partial)
            ledger.ended(job, outcome(job.finished.args[0], float(words[words.index("--max-seconds") + 1])))
        return ledger.failures

    return run


def draw(planned: PlannedRun, seed: int, names: tuple[str, ...] = ("0000_r_0", "0001_r_1"), size: int = 64) -> None:
    """Write renders with the worst error in the upper left quarter, and their photographs."""
    import torch

    noise = torch.from_numpy(np.random.default_rng(0).random((size, size, 3))).float()
    wrong = torch.from_numpy(np.random.default_rng(seed).random((size, size, 3))).float() * 0.05
    wrong[: size // 2, : size // 2] *= 10
    for name in names:
        write_image(planned.pictures / f"{name}.png", (noise + wrong).clamp(0, 1))
        write_image(planned.pictures / f"{name}_photograph.png", noise)
