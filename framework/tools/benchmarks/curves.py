"""Curves of error against evaluations: where they meet an error, and their pictures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from framework.base.console import say
from framework.tools.comparison import plots

LEAST_ERROR = 1e-12
"""Stands for 0, which has no logarithm."""


class Curve(NamedTuple):
    """One sampler's errors on one scene, in the order of its sweep."""

    evaluations: list[float]
    """Of the field, a ray."""
    in_all: list[float]
    """With those of what says where to look."""
    errors: list[float]
    """Mean absolute error of a colour channel."""
    half_widths: list[float]
    """Of the errors' 95 % intervals."""


def evaluations_needed(evaluations: Sequence[float], errors: Sequence[float], target: float) -> float | None:
    """Evaluations at which a curve first meets an error; a power law is assumed between neighbouring points.

    Args:
        evaluations, errors: of as many points, in the order of the sweep.
    Returns: None where no point meets it; the first point's evaluations where that does already.
    """
    if errors and errors[0] <= target:
        return evaluations[0]
    for (few, above), (more, below) in pairwise(zip(evaluations, errors, strict=True)):
        if below <= target < above:
            share = math.log(above / target) / math.log(above / max(below, LEAST_ERROR))
            return float(few ** (1 - share) * more**share)
    return None


def draw(curves: dict[str, dict[str, Curve]], folder: Path) -> list[Path]:
    """A picture of each scene, with a curve for each sampler: error over evaluations of the field, both logarithmic.

    Where others say where to look, a dashed line is over all evaluations.

    Returns: the pictures' paths; none where matplotlib is absent, which is said.
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
        errors, color = [max(error, LEAST_ERROR) for error in curve.errors], f"C{index}"
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
