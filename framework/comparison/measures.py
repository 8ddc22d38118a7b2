"""Measurements of finished runs, read from their folders, and their statistics over several seeds."""

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

from nerfloom.comparison.plan import Conditions, PlannedRun

TIME_TOLERANCE = 0.01
"""Maximum relative difference of equal times: a run ends with the step that uses up its time."""
Curve = tuple[tuple[float, float], ...]
"""Pairs (seconds of training, PSNR on the validation views), in order."""


@dataclass(frozen=True)
class Measured:
    """Measurements of one run.

    Args:
        method: name of the method.
        seed: seed of the run.
        ssim: mean SSIM over all evaluated views.
        ms_ssim: mean SSIM at five scales; None for small images.
        lpips: mean LPIPS over all evaluated views; None if it was not computed.
        floaters: mean percentage of sparse points with matter in front of them; None without sparse points.
        normal_mae: mean angle between rendered and true normals, degrees; None without either.
        diffuse_psnr: mean PSNR of diffuse light, dB; None without either.
        steps: number of training steps.
        parameters: number of parameters.
        skipped_steps: number of steps dropped because of non-finite values.
        curve: the learning curve.
        machine: description of the machine.
        folder: folder of the run.
        lpips_note: how LPIPS was computed, or the reason for its absence.
        masks_note: description of the metrics of masked images; None if all pixels count.
        geometry: metrics of the surface as in eval.json; None without a reference.
    """

    label: str
    """Label of the contender."""
    method: str
    seed: int
    psnr: float
    """Mean PSNR of the final model over all evaluated views, dB."""
    ssim: float | None
    ms_ssim: float | None
    lpips: float | None
    floaters: float | None
    normal_mae: float | None
    diffuse_psnr: float | None
    views: int
    """Number of evaluated views."""
    steps: int
    seconds: float
    """Seconds of training."""
    rays_per_second: float
    """Rays per second of training."""
    render_seconds: float
    """Seconds per rendered image."""
    peak_memory_bytes: int
    """Peak memory in training, bytes."""
    parameters: int
    skipped_steps: int
    curve: Curve
    seconds_to: dict[int, float]
    """Integer PSNR, dB -> training time when the curve reached it, seconds."""
    decisions: tuple[str, ...]
    """Decisions of the scene's profile."""
    skipped: tuple[str, ...]
    """Work skipped by the run."""
    machine: dict[str, Any]
    command: str
    """The training command."""
    folder: str
    lpips_note: str
    masks_note: str | None
    geometry: dict[str, Any] | None = None

    @property
    def chamfer(self) -> float | None:
        """Chamfer distance in per cent of the reference's longest side; None without a reference."""
        return None if self.geometry is None else self.geometry["chamfer_percent"]

    @property
    def f_score(self) -> float | None:
        """F-score at the smallest distance, per cent; None without a reference."""
        return None if self.geometry is None else 100 * self.geometry["f_scores"][0]["f_score"]

    @property
    def normal_error(self) -> float | None:
        """Mean angle between normals, degrees; None without a reference or its normals."""
        normals = None if self.geometry is None else self.geometry["normals"]
        return None if normals is None else normals["degrees"]

    @property
    def faces(self) -> float | None:
        """Number of faces of the mesh that was judged; None without a reference."""
        return None if self.geometry is None else self.geometry["faces"]

    def as_plain(self) -> dict[str, Any]:
        """Return the measurements as a dictionary for JSON."""
        return {**asdict(self), "seconds_to": {str(level): s for level, s in self.seconds_to.items()}}


def measure(planned: PlannedRun, conditions: Conditions) -> Measured | None:
    """Return the measurements of a `planned` run under `conditions`; None if unfinished or its images not finite."""
    summary, evaluation = read_json(planned.folder / "summary.json"), read_json(planned.evaluation)
    if not isinstance(summary, dict) or not isinstance(evaluation, dict):
        return None
    results = evaluation["results"]
    if results["psnr"] is None:
        return None
    points = read_json(planned.folder / "learning_curve.json") or []
    full = [
        p for p in points if p.get("full", True) and p["psnr"] is not None
    ]  # evaluations of other numbers of images are not comparable
    curve = tuple((float(p["seconds"]), float(p["psnr"])) for p in full)
    skips = read_json(planned.folder / "skip_report.json") or []
    return Measured(
        label=planned.contender.label,
        method=planned.contender.method,
        seed=planned.seed,
        psnr=results["psnr"],
        ssim=results["ssim"],
        ms_ssim=results.get("ms_ssim"),
        lpips=results["lpips"],
        floaters=results.get("floaters"),
        normal_mae=results.get("normal_mae"),
        diffuse_psnr=results.get("diffuse_psnr"),
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
        decisions=decisions_of(planned.folder),
        skipped=tuple(f"{skip['skipped']:.1%} of {skip['name']}" for skip in skips),
        machine=summary["machine"],
        command=shlex.join(planned.user_command(conditions)),
        folder=str(planned.folder),
        lpips_note=evaluation["lpips"],
        masks_note=evaluation.get("masks"),
        geometry=evaluation.get("geometry"),
    )


def decisions_of(folder: Path) -> tuple[str, ...]:
    """Return the decisions of the scene's profile in the `folder` of a run; none if it has no profile."""
    profile = read_json(folder / "scene_profile.json") or {}
    return tuple(f"{d['option']}: {d['choice']}, as {d['reason']}" for d in profile.get("decisions", []))


def read_json(path: Path) -> Any:
    """Return the content of the JSON file `path`, or None if it is missing or invalid."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def whole_levels(curve: Curve) -> dict[int, float]:
    """Return the time when a `curve` first reached each integer PSNR, interpolated linearly between its points.

    The level of the first point counts as reached there, because nothing was measured earlier.

    Returns:
        Integer PSNR, dB -> seconds.
    """
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
    """Measurements of a contender over its seeds: means, and the standard deviation of a single run.

    Args:
        label: label of the contender.
        runs: its finished runs.
    """

    label: str
    runs: tuple[Measured, ...]
    failures: tuple[str, ...]
    """Reasons of failures of its other runs."""

    def mean(self, name: str) -> float | None:
        """Return the mean of the measurement `name` of `Measured`; None if a run lacks it."""
        values = [getattr(run, name) for run in self.runs]
        return None if not values or None in values else fmean(values)

    def deviation(self, name: str) -> float | None:
        """Return the standard deviation of the measurement `name`; None for fewer than two runs."""
        values = [getattr(run, name) for run in self.runs]
        return None if len(values) < 2 or None in values else stdev(values)

    def seconds_to(self, level: int) -> float | None:
        """Return the mean seconds to the PSNR `level`; None if a run did not reach it or started above it."""
        values = [run.seconds_to.get(level) for run in self.runs]
        reached = [value for value in values if value is not None]
        return fmean(reached) if reached and len(reached) == len(values) else None

    def seconds_before(self, level: int) -> float | None:
        """Return the latest time of a first evaluation, seconds, if all runs were above `level` there."""
        firsts = [min(run.seconds_to.items(), default=(-math.inf, 0.0)) for run in self.runs]
        return max((s for _, s in firsts), default=None) if all(level < first for first, _ in firsts) else None


def rows_of(labels: Sequence[str], runs: Sequence[Measured], failures: dict[str, list[str]]) -> list[Row]:
    """Return a row for each contender in `labels`, from all finished `runs` and reasons of `failures` by label."""
    return [
        Row(label, tuple(run for run in runs if run.label == label), tuple(failures.get(label, ()))) for label in labels
    ]


def pareto(points: Sequence[tuple[float, float]]) -> list[bool]:
    """Return whether each point is on the Pareto front: no other point has at most its cost and at least its quality.

    Args:
        points: pairs (cost, quality). Lower cost is better, and costs within `TIME_TOLERANCE` are equal; higher quality
            is better. Another point must be strictly better in one of the two.
    """

    def dominated(cost: float, quality: float) -> bool:
        no_costlier = [(c, q) for c, q in points if c <= cost * (1 + TIME_TOLERANCE)]
        return any(q > quality or (q == quality and c < cost * (1 - TIME_TOLERANCE)) for c, q in no_costlier)

    return [not dominated(*point) for point in points]
