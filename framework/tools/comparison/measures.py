"""Figures of finished runs, read from their folders; and what several seeds say together."""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

from framework.tools.comparison.plan import Conditions, Job

SAME_TIME = 0.01
"""Relative difference below which two times are the same: runs end with the step in which their seconds do."""
Curve = tuple[tuple[float, float], ...]
"""(seconds of training, PSNR on the validation views), in order."""


@dataclass(frozen=True)
class Measured:
    """One run's figures."""

    label: str
    """The contender."""
    method: str
    seed: int
    psnr: float
    """Of the final model, mean over all views judged, dB."""
    ssim: float | None
    lpips: float | None
    views: int
    """How many were judged."""
    steps: int
    seconds: float
    """Of training."""
    rays_per_second: float
    """In training."""
    render_seconds: float
    """An image."""
    peak_memory_bytes: int
    """In training."""
    parameters: int
    skipped_steps: int
    curve: Curve
    seconds_to: dict[int, float]
    """Whole dB on the curve -> seconds after which it was reached."""
    decisions: tuple[str, ...]
    """What the scene's profile decided."""
    skipped: tuple[str, ...]
    """What the run skipped."""
    machine: dict[str, Any]
    command: str
    """That trained it."""
    folder: str
    lpips_note: str

    def as_plain(self) -> dict[str, Any]:
        """For JSON."""
        return {**asdict(self), "seconds_to": {str(level): s for level, s in self.seconds_to.items()}}


def measure(job: Job, conditions: Conditions) -> Measured | None:
    """A finished job's figures; None for one that is not finished."""
    summary, evaluation = read_json(job.folder / "summary.json"), read_json(job.evaluation)
    if not isinstance(summary, dict) or not isinstance(evaluation, dict):
        return None
    results = evaluation["results"]
    points = read_json(job.folder / "learning_curve.json") or []
    full = [p for p in points if p.get("full", True) and p["psnr"] is not None]  # looks at a few images do not compare
    curve = tuple((float(p["seconds"]), float(p["psnr"])) for p in full)
    profile, rungs = (
        read_json(job.folder / "scene_profile.json") or {},
        read_json(job.folder / "skip_report.json") or [],
    )
    return Measured(
        label=job.contender.label,
        method=job.contender.method,
        seed=job.seed,
        psnr=results["psnr"],
        ssim=results["ssim"],
        lpips=results["lpips"],
        views=results["num_images"],
        steps=summary["steps"],
        seconds=summary["seconds"],
        rays_per_second=summary["rays_per_second"],
        render_seconds=1 / results["fps"],
        peak_memory_bytes=summary["peak_memory_bytes"],
        parameters=summary["parameters"],
        skipped_steps=summary["skipped_steps"],
        curve=curve,
        seconds_to=whole_levels(curve),
        decisions=tuple(f"{d['option']}: {d['choice']}, as {d['reason']}" for d in profile.get("decisions", [])),
        skipped=tuple(f"{rung['skipped']:.1%} of {rung['name']}" for rung in rungs),
        machine=summary["machine"],
        command=shlex.join(["ns-train", job.contender.method, *_told(job, conditions)]),
        folder=str(job.folder),
        lpips_note=evaluation["lpips"],
    )


def _told(job: Job, conditions: Conditions) -> list[str]:
    """The flags that a user would give to get the same training: without those that name the comparison's folders."""
    flags = [*job.contender.flags, *conditions.data_flags, "--machine.seed", str(job.seed)]
    for name in ("data", "max_seconds", "max_num_iterations", "target_psnr"):
        value = getattr(conditions, name)
        flags += [] if value is None else ["--" + name.replace("_", "-"), str(value)]
    return flags


def read_json(path: Path) -> Any:
    """Its content; None where it is missing or no JSON."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def whole_levels(curve: Curve) -> dict[int, float]:
    """When a curve first reached each whole dB, between its points by straight lines; the first point's level counts
    as reached there, for what was before it was not measured."""
    reached: dict[int, float] = {}
    if not curve:
        return reached
    seconds, psnr = curve[0]
    reached[math.floor(psnr)] = seconds
    best = psnr
    for (t0, p0), (t1, p1) in pairwise(curve):
        for level in range(math.floor(best) + 1, math.floor(p1) + 1):
            reached[level] = t0 + (t1 - t0) * (level - p0) / (p1 - p0)
        best = max(best, p1)
    return reached


@dataclass(frozen=True)
class Row:
    """A contender's figures over its seeds: means, and the standard deviation of a single run where there are two."""

    label: str
    runs: tuple[Measured, ...]
    failures: tuple[str, ...]
    """Why other runs of it failed."""

    def mean(self, name: str) -> float | None:
        """Of a figure of `Measured`; None where a run lacks it."""
        values = [getattr(run, name) for run in self.runs]
        return None if not values or None in values else fmean(values)

    def deviation(self, name: str) -> float | None:
        """Of a single run; None for fewer than two."""
        values = [getattr(run, name) for run in self.runs]
        return None if len(values) < 2 or None in values else stdev(values)

    def seconds_to(self, level: int) -> float | None:
        """Mean seconds to a whole dB; None where a run did not reach it, or had passed it when it was first judged."""
        values = [run.seconds_to.get(level) for run in self.runs]
        found = [value for value in values if value is not None]
        return fmean(found) if found and len(found) == len(values) else None


def rows_of(labels: Sequence[str], runs: Sequence[Measured], failures: dict[str, list[str]]) -> list[Row]:
    """A row for each contender, in the order given."""
    return [
        Row(label, tuple(run for run in runs if run.label == label), tuple(failures.get(label, ()))) for label in labels
    ]


def pareto(points: Sequence[tuple[float, float]]) -> list[bool]:
    """Which points (cost, quality) no other one beats: at most the cost and at least the quality, one of them strictly.

    Args:
        points: cost, less being better, those within `SAME_TIME` being the same; quality, more being better.
    """

    def beaten(cost: float, quality: float) -> bool:
        as_cheap = [(c, q) for c, q in points if c <= cost * (1 + SAME_TIME)]
        return any(q > quality or (q == quality and c < cost * (1 - SAME_TIME)) for c, q in as_cheap)

    return [not beaten(*point) for point in points]
