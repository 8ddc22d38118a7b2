"""PSNR against training seconds of several methods: a run from scratch for every budget and seed.

Schedules and sizes depend on the budget, so the curve of one long run would underestimate what a method reaches in a
shorter time. The runs are a comparison's (`nerfloom.comparison`), in a folder for each budget. Existing runs
are kept, so a stopped benchmark can continue, and methods, budgets and seeds can be added.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.table import Table

from nerfloom.base.errors import FlagError
from nerfloom.benchmarks.methods import STANDARD
from nerfloom.comparison import plots
from nerfloom.comparison.measures import Row, measure, rows_of
from nerfloom.comparison.plan import Conditions, Contender, Plan
from nerfloom.comparison.runner import run_all
from nerfloom.jobs.processes import Processes
from nerfloom.registry import registered


@dataclass(frozen=True)
class Budget:
    """Results of all methods with one budget."""

    seconds: float
    """Training seconds of each run."""
    rows: tuple[Row, ...]
    """Results of each method, in the order of the methods."""


def all_methods() -> tuple[str, ...]:
    """Return all installed methods, with their recommended flags for a CPU."""
    with_flags = {text.split()[0]: text for text in STANDARD}
    return tuple(with_flags.get(name, name) for name in registered("methods"))


def plans(
    methods: Sequence[str], data: Path | None, budgets: Sequence[float], seeds: int, views: int, folder: Path
) -> list[Plan]:
    """Return the runs as a comparison for each budget, shortest first.

    Args:
        methods: methods, each with its own flags; `all_methods` if empty.
        data: folder of the data set; the embedded scene if None.
        budgets: seconds of training.
        seeds: number of runs of each method with each budget.
        views: maximum number of held-out views to evaluate.
        folder: folder of the runs.

    Raises:
        ConfigError: if a method is unknown, there is no budget, or a number is out of range.
    """
    if not budgets:
        raise FlagError("--budgets is empty; list seconds of training, such as --budgets 10 45 150")
    contenders = tuple(map(Contender.of, methods or all_methods()))
    root = None if data is None else str(data.resolve())
    return [
        Plan(contenders, conditions(root, (), seconds, views), seeds, folder.resolve() / f"{seconds:g}s")
        for seconds in sorted(set(budgets))
    ]


def conditions(data: str | None, flags: tuple[str, ...], seconds: float, views: int | None) -> Conditions:
    """Return the conditions of runs on all cores, without a learning curve.

    Args:
        data: folder of the data set; the embedded scene if None.
        flags: flags of its format.
        seconds: seconds of training.
        views: maximum number of held-out views to evaluate; None for all.
    """
    return Conditions(data, flags, seconds, curve_images=0, max_eval_images=views)


def run(plan: Plan) -> Budget:
    """Train and evaluate the missing runs of a `plan`, which are those of one budget.

    Returns:
        The measurements, with the reasons of failures.

    Raises:
        ConfigError: if the folder has runs under other conditions or cannot be written.
        Stopped: on a signal; finished runs are kept.
    """
    plan.claim_folder()
    failures: dict[str, list[str]] = {}
    for planned, failure in run_all(plan, Processes()).items():
        failures.setdefault(planned.contender.label, []).append(f"seed {planned.seed}: {failure.reason}")
    done = [found for found in (measure(planned, plan.conditions) for planned in plan.runs()) if found is not None]
    assert plan.conditions.max_seconds is not None
    return Budget(plan.conditions.max_seconds, tuple(rows_of([c.label for c in plan.contenders], done, failures)))


def published(plan: Plan, found: Sequence[Budget]) -> dict[str, Any]:
    """Return the results `found` of all budgets as plain data, without the machine's paths; `plan` is of any budget."""
    runs = [run for budget in found for row in budget.rows for run in row.runs]
    machines: list[dict[str, Any]] = []
    for run in runs:
        machines += [] if run.machine in machines else [run.machine]
    return {
        "data": "procedural" if plan.conditions.data is None else Path(plan.conditions.data).name,
        "held-out views": sorted({run.views for run in runs}),
        "seeds": plan.repeats,
        "machines": machines,
        "methods": [
            {"method": label, "points": [_point(budget, budget.rows[index]) for budget in found]}
            for index, label in enumerate(contender.label for contender in plan.contenders)
        ],
    }


def _point(budget: Budget, row: Row) -> dict[str, Any]:
    """Return the results of one method with one budget."""

    def mean(name: str, digits: int) -> float | None:
        value = row.mean(name)
        return None if value is None else round(value, digits)

    spread = row.deviation("psnr")
    return {
        "budget, s": budget.seconds,
        "training, s": mean("seconds", 2),
        "PSNR, dB": mean("psnr", 3),
        "standard deviation of a run, dB": None if spread is None else round(spread, 3),
        "PSNR of each seed, dB": {str(run.seed): round(run.psnr, 3) for run in row.runs},
        "SSIM": mean("ssim", 4),
        "steps": mean("steps", 0),
        "rendering, s/image": mean("render_seconds", 4),
        "memory, GiB": None if not row.runs else round(max(run.peak_memory_bytes for run in row.runs) / 2**30, 2),
        "failures": list(row.failures),
    }


def table(plan: Plan, found: Sequence[Budget]) -> Table:
    """Return PSNR by method and budget for a terminal, with the standard deviation of a run if there are several seeds.

    `plan` and `found` are as in `published`.
    """
    result = Table("PSNR, dB, after", *(f"{budget.seconds:g} s" for budget in found))
    for index, contender in enumerate(plan.contenders):
        result.add_row(contender.label, *(_cell(budget.rows[index]) for budget in found))
    return result


def _cell(row: Row) -> str:
    if not row.runs:
        return "failed" if row.failures else "–"
    spread = row.deviation("psnr")
    return f"{row.mean('psnr'):.2f}" + ("" if spread is None else f" ± {spread:.2f}")


def draw(plan: Plan, found: Sequence[Budget]) -> str:
    """Plot PSNR against seconds of training: means over seeds, and a band from the worst seed to the best.

    `plan` and `found` are as in `published`.

    Returns:
        The plot as an SVG element.
    """
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 5.5), layout="constrained")
    FigureCanvasSVG(figure)
    axes = figure.subplots()
    for index, contender in enumerate(plan.contenders):
        rows = [budget.rows[index] for budget in found if budget.rows[index].runs]
        seconds = [row.mean("seconds") or 0.0 for row in rows]
        seeds = [[run.psnr for run in row.runs] for row in rows]
        color, dashes = plots.color_of(index), "-" if index < len(plots.COLORS) else "--"
        psnrs = [row.mean("psnr") or 0.0 for row in rows]
        axes.plot(seconds, psnrs, dashes, color=color, marker="o", markersize=4, label=contender.label)
        axes.fill_between(seconds, list(map(min, seeds)), list(map(max, seeds)), color=color, alpha=0.2, linewidth=0)
    plots.over_seconds(axes, "training, s")
    axes.set_ylabel("PSNR, dB")
    axes.legend(fontsize="small", loc="best")
    return plots.as_svg(figure)
