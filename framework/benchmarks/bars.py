"""Bar charts of kernel times, compiled and in torch, with the machine's limits."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from nerfloom.base.console import say
from nerfloom.benchmarks.kernels import UNITS, Row
from nerfloom.comparison import plots


def draw(rows: Sequence[Row], path: Path) -> None:
    """Draw the times of kernels in `rows`, ns on a logarithmic axis, to the file `path`, or report why not."""
    if not plots.available():
        say(plots.MISSING)
        return
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 0.42 * len(rows) + 1), layout="constrained")
    axes = figure.subplots()
    heights = range(len(rows), 0, -1)
    ours = [row.forward + (row.backward or 0) for row in rows]
    theirs = [row.reference_forward + (row.reference_backward or 0) for row in rows]
    axes.barh([height + 0.2 for height in heights], theirs, 0.4, color="#bbbbbb", label="torch")
    axes.barh([height - 0.2 for height in heights], ours, 0.4, color="#0072b2", label="compiled")
    marks = [(height - 0.2, row.at_ceiling) for height, row in zip(heights, rows, strict=True) if row.at_ceiling]
    mark_heights, bounds = zip(*marks, strict=True) if marks else ((), ())
    axes.plot(bounds, mark_heights, "|", color="#d55e00", markersize=11, label="forward at the ceiling")
    for height, row, value in zip(heights, rows, theirs, strict=True):
        axes.text(value * 1.1, height, f"{row.speed_up:.1f} x", va="center", fontsize=8)
    axes.set(xscale="log", xlabel=f"ns a {UNITS}, forward and backward, {rows[0].threads} threads")
    axes.set_yticks(list(heights), [row.kernel for row in rows], fontsize=8)
    axes.margins(x=0.1)
    axes.legend(fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)
