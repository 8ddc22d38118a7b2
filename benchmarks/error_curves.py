"""Curves of error against evaluations of a field: evaluations needed for a given error, and plots."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from nerfloom.base.console import say
from nerfloom.comparison import plots

MIN_ERROR = 1e-12
"""Replaces an error of 0, which has no logarithm."""


class Curve(NamedTuple):
    """Errors of a sampler on a scene, in the order of the sweep."""

    evaluations: list[float]
    """Evaluations of the field per ray."""
    in_all: list[float]
    """Evaluations of the field and of coarse fields or proposals per ray."""
    errors: list[float]
    """Mean absolute errors of a colour channel."""
    half_widths: list[float]
    """Half widths of the errors' 95 % confidence intervals."""


def evaluations_needed(evaluations: Sequence[float], errors: Sequence[float], target: float) -> float | None:
    """Return the number of evaluations where a curve first reaches an error, by a power law between neighbouring
    points.

    Args:
        evaluations, errors: coordinates of the points, in the order of the sweep.
        target: the error.

    Returns:
        Number of evaluations; the first point's if it reaches the error, None if no point does.
    """
    if errors and errors[0] <= target:
        return evaluations[0]
    for (few, above), (more, below) in pairwise(zip(evaluations, errors, strict=True)):
        if below <= target < above:
            share = math.log(above / target) / math.log(above / max(below, MIN_ERROR))
            return float(few ** (1 - share) * more**share)
    return None


def draw(curves: dict[str, dict[str, Curve]], folder: Path) -> list[Path]:
    """Draw a plot for each scene, with a curve for each sampler: error over evaluations of the field, both logarithmic.

    For samplers with coarse fields or proposals, a dashed line shows all evaluations.

    Args:
        curves: curves by scene and sampler.
        folder: folder of the plots, created if missing.

    Returns:
        Paths of the plots; empty if matplotlib is not installed, which is reported.
    """
    if not plots.available():
        say(plots.MISSING)
        return []
    folder.mkdir(parents=True, exist_ok=True)
    return [_draw_scene(scene, by_sampler, folder / f"quadrature-{scene}.png") for scene, by_sampler in curves.items()]


def _draw_scene(scene: str, by_sampler: dict[str, Curve], path: Path) -> Path:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 5), layout="constrained")
    axes = figure.subplots()
    for index, (name, curve) in enumerate(by_sampler.items()):
        errors, color = [max(error, MIN_ERROR) for error in curve.errors], f"C{index}"
        axes.errorbar(curve.evaluations, errors, curve.half_widths, marker="o", markersize=3, color=color, label=name)
        if curve.in_all != curve.evaluations:
            axes.plot(curve.in_all, errors, "--", linewidth=1, color=color)
    axes.set(xscale="log", yscale="log", title=scene)
    axes.set(
        xlabel="evaluations a ray (dashed: with those of coarse fields and proposals)",
        ylabel="mean absolute error of colour",
    )
    axes.grid(True, which="both", alpha=0.3)
    axes.legend()
    figure.savefig(path, dpi=120)
    return path
