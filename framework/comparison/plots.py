"""Plots of PSNR against time: each contender's learning curve and final result, as one SVG."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

from nerfloom.base.extras import install_command
from nerfloom.comparison.measures import Row, pareto

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8c564b", "#7f7f7f")
"""Okabe and Ito's colours, distinguishable for colour-blind readers."""
MISSING = "without plots: pip install matplotlib"
"""Message if matplotlib is not installed."""


def available() -> bool:
    """Return whether matplotlib is installed."""
    return install_command("plots") is None


def color_of(index: int) -> str:
    """Return the colour of the contender with index `index`."""
    return COLORS[index % len(COLORS)]


def time_against_error(rows: Sequence[Row]) -> str:
    """Plot PSNR of `rows` against training seconds, and against rendering seconds per image, with the Pareto fronts.

    Curves use the views evaluated during training; final points, with a bar of one standard deviation, use all views.

    Returns:
        The plot as an SVG element.
    """
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4.2), layout="constrained")
    FigureCanvasSVG(figure)
    training, rendering = figure.subplots(1, 2, sharey=True)
    finished = [(index, row) for index, row in enumerate(rows) if row.runs]
    for index, row in finished:
        color = color_of(index)
        for run in row.runs:
            if run.curve:
                training.plot(*zip(*run.curve, strict=True), color=color, linewidth=1, alpha=0.6)
        psnr, spread = row.mean("psnr"), row.deviation("psnr")
        for axes, cost in ((training, row.mean("seconds")), (rendering, row.mean("render_seconds"))):
            axes.errorbar([cost], [psnr], [spread or 0], color=color, marker="o", markersize=6, label=row.label)
    for axes, name in ((training, "seconds"), (rendering, "render_seconds")):
        _front(axes, [(row.mean(name) or 0.0, row.mean("psnr") or 0.0) for _, row in finished])
    over_seconds(training, "training, s")
    over_seconds(rendering, "rendering, s per image")
    training.set_ylabel("PSNR, dB")
    rendering.legend(fontsize="small", loc="best")
    return as_svg(figure)


def over_seconds(axes: Any, label: str) -> None:
    """Give `axes` of matplotlib a logarithmic x-axis with a `label`, with ticks at 1, 2 and 5, and a grid."""
    from matplotlib.ticker import LogLocator, NullFormatter

    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.grid(True, which="both", linewidth=0.3, alpha=0.6)
    axes.set_xlabel(label)


def as_svg(figure: Any) -> str:
    """Return a `figure` of matplotlib as an SVG element."""
    text = io.StringIO()
    figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    svg = text.getvalue()
    return svg[svg.index("<svg") :]


def _front(axes: Any, points: Sequence[tuple[float, float]]) -> None:
    front = sorted(point for point, best in zip(points, pareto(points), strict=True) if best)
    if len(front) > 1:
        costs, qualities = zip(*front, strict=True)
        axes.step(costs, qualities, where="post", color="black", linewidth=0.8, linestyle=":", zorder=0)
