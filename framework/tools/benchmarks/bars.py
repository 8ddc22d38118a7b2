"""Bars of what kernels take, compiled and in torch, beside the machine's ceilings."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from framework.base.console import say
from framework.tools.benchmarks.kernels import Row
from framework.tools.comparison import plots


def draw(rows: Sequence[Row], path: Path) -> bool:
    """A picture of one thread count's rows: ns forward and backward, logarithmic.

    Returns: whether it was drawn; it is not where matplotlib is absent, which is said.
    """
    if not plots.available():
        say(plots.MISSING)
        return False
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 0.42 * len(rows) + 1), layout="constrained")
    axes = figure.subplots()
    places = range(len(rows), 0, -1)
    ours = [row.forward + (row.backward or 0) for row in rows]
    theirs = [row.reference_forward + (row.reference_backward or 0) for row in rows]
    axes.barh([place + 0.2 for place in places], theirs, 0.4, color="#bbbbbb", label="torch")
    axes.barh([place - 0.2 for place in places], ours, 0.4, color="#0072b2", label="compiled")
    marks = [(place - 0.2, row.at_ceiling) for place, row in zip(places, rows, strict=True) if row.at_ceiling]
    heights, bounds = zip(*marks, strict=True) if marks else ((), ())
    axes.plot(bounds, heights, "|", color="#d55e00", markersize=11, label="forward at the ceiling")
    for place, row, value in zip(places, rows, theirs, strict=True):
        axes.text(value * 1.1, place, f"{row.speed_up:.1f} x", va="center", fontsize=8)
    axes.set(xscale="log", xlabel=f"ns a sample, ray, entry or pixel, forward and backward, {rows[0].threads} threads")
    axes.set_yticks(list(places), [row.kernel for row in rows], fontsize=8)
    axes.margins(x=0.1)
    axes.legend(fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)
    return True
