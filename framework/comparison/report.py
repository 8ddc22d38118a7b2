"""Reports of a comparison: report.html, report.md, results.json, results.csv."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from importlib.resources import files
from pathlib import Path
from typing import Any

from rich.table import Table

from nerfloom.base.atomic import write_atomically
from nerfloom.base.json_files import write_json
from nerfloom.comparison import plots
from nerfloom.comparison.crops import views
from nerfloom.comparison.measures import TIME_TOLERANCE, Measured, Row, pareto
from nerfloom.comparison.plan import Conditions, Plan
from nerfloom.evaluation.images import ERROR_AT_WHITE
from nerfloom.evaluation.lpips import NETWORK


@dataclass(frozen=True)
class Column:
    """A column of the table of results.

    Args:
        title: heading.
        show: formats a value.
    """

    title: str
    figure: str
    """Name of the measurement in `Measured`."""
    show: Callable[[float], str]
    best: Callable[[Sequence[float]], float] | None
    """`max` if higher is better, `min` if lower is better, or None."""
    same: float = 1e-9
    """Maximum relative difference of two values that count as equally good."""


COLUMNS = (
    Column("PSNR, dB", "psnr", "{:.2f}".format, max),
    Column("SSIM", "ssim", "{:.4f}".format, max),
    Column("MS-SSIM", "ms_ssim", "{:.4f}".format, max),
    Column(f"LPIPS ({NETWORK})", "lpips", "{:.4f}".format, min),
    Column("floaters, %", "floaters", "{:.1f}".format, min),
    Column("normals of views, °", "normal_mae", "{:.2f}".format, min),
    Column("diffuse PSNR, dB", "diffuse_psnr", "{:.2f}".format, max),
    Column("Chamfer, % of side", "chamfer", "{:.3f}".format, min),
    Column("F-score, %", "f_score", "{:.1f}".format, max),
    Column("normals, °", "normal_error", "{:.2f}".format, min),
    Column("faces", "faces", "{:,.0f}".format, None),
    Column("training, s", "seconds", "{:.1f}".format, min, TIME_TOLERANCE),
    Column("steps", "steps", "{:,.0f}".format, None),
    Column("training, rays/s", "rays_per_second", "{:,.0f}".format, None),  # pixels for methods that render images
    Column("rendering, s/image", "render_seconds", "{:.2f}".format, min),
    Column("peak memory, GiB", "peak_memory_bytes", lambda value: f"{value / 2**30:.2f}", min),
    Column("parameters", "parameters", "{:,.0f}".format, min),
)
"""The columns of the table of results."""


@dataclass(frozen=True)
class Cell:
    """A value in a table.

    Args:
        text: the formatted value.
        best: whether it is the best of its column.
    """

    text: str
    best: bool = False


def write_report(plan: Plan, rows: Sequence[Row], sharing: str | None = None) -> Path:
    """Write all four files of `plan` and `rows`, and return the path of report.html.

    `sharing` is a sentence on other work of machines during a run; None if each run was alone.
    """
    runs = [run for row in rows for run in row.runs]
    content = _content(plan, rows, runs)
    content["conditions"] += [] if sharing is None else [f"{sharing} Times are longer where runs share a machine."]
    template = files("nerfloom.comparison").joinpath("report.html.jinja").read_text(encoding="utf-8")
    import jinja2  # a dependency of PyTorch

    pages = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined)
    _write(plan.folder / "report.html", pages.from_string(template).render(content))
    _write(plan.folder / "report.md", markdown(content))
    _write(plan.folder / "results.csv", _csv(runs))
    plain = {
        "conditions": vars(plan.conditions),
        "repeats": plan.repeats,
        "methods": [row.label for row in rows],
        "failures": {row.label: list(row.failures) for row in rows if row.failures},
        "runs": [run.as_plain() for run in runs],
    }
    write_json(plan.folder / "results.json", plain)
    return plan.folder / "report.html"


def _write(path: Path, text: str) -> None:
    write_atomically(path, lambda file: file.write(text.encode()))


def _content(plan: Plan, rows: Sequence[Row], runs: Sequence[Measured]) -> dict[str, Any]:
    """Return the content shared by the HTML and Markdown reports."""
    folders = [(row.label, Path(row.runs[0].folder) / "views") for row in rows if row.runs]
    figure = plots.time_against_error(rows) if runs and plots.available() else None
    data = Path(plan.conditions.data).name if plan.conditions.data else "the embedded scene"
    return {
        "title": f"{len(rows)} methods on {data}",
        "when": datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M UTC"),
        "budget": plan.conditions.budget(),
        "conditions": condition_lines(plan.conditions, plan.repeats, runs),
        "columns": [column.title for column in measured(rows)],
        "rows": table(rows),
        "levels": levels(rows),
        "level_rows": level_table(rows),
        "failures": [(row.label, reason) for row in rows for reason in row.failures],
        "figure": figure,
        "no_figure": plots.MISSING,
        "views": views(folders),
        "error_at_white": ERROR_AT_WHITE,
        "details": [
            {"label": row.label, "color": plots.color_of(index), "run": row.runs[0]}
            for index, row in enumerate(rows)
            if row.runs
        ],
        "machines": machines(runs),
    }


def condition_lines(conditions: Conditions, repeats: int, runs: Sequence[Measured]) -> list[str]:
    """Return the `conditions` of `runs` with `repeats` seeds as sentences."""
    counts = sorted({run.views for run in runs})
    evaluated = " or ".join(map(str, counts)) or "all"
    lines = [
        f"Every method had {conditions.budget()}, each run in its own process.",
        f"Final results are means over {evaluated} held-out views{_of_all(conditions)}; "
        + (
            f"learning curves are over at most {conditions.curve_images} views, whose evaluation does not count as "
            "training time."
            if conditions.curve_images
            else "there are no learning curves."
        ),
        f"{repeats} seed{'s' if repeats > 1 else ''} per method"
        + (
            ": means, ± the standard deviation of a single run."
            if repeats > 1
            else "; --repeats 3 would show how much runs differ."
        ),
    ]
    if used := sorted({str(run.machine.get("kernels")) for run in runs}):
        lines.append(f"Kernels: {' and '.join(used)}.")
    lines += [f"LPIPS: {note}." for note in sorted({run.lpips_note for run in runs})]
    lines += [f"Masks: {note}." for note in sorted({run.masks_note for run in runs if run.masks_note})]
    return lines + sorted({_surfaces(run.geometry) for run in runs if run.geometry is not None})


def _surfaces(geometry: dict[str, Any]) -> str:
    """Return how surfaces were compared with a reference, as a sentence."""
    near = geometry["f_scores"][0]["distance"]
    return (
        f"Surfaces are compared with {Path(geometry['reference']).name} (longest side {geometry['side']:.4g}); "
        f"F-score at {near:.4g}, both in the input's unit."
    )


def _of_all(conditions: Conditions) -> str:
    """Return a note on the choice of held-out views, if it may exclude some."""
    most = conditions.max_eval_images
    return "" if most is None else f" (at most {most}, evenly spaced; --max-eval-images sets how many)"


def measured(rows: Sequence[Row]) -> list[Column]:
    """Return the columns with a value for some contender of `rows`; all of them if none has finished."""
    return [c for c in COLUMNS if any(row.mean(c.figure) is not None for row in rows)] or list(COLUMNS)


def table(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Return the table of results of `rows`: for each its label, colour, Pareto flag, and a cell for each column.

    A row without results has no cells, and a word instead.
    """
    finished = [row for row in rows if row.runs]
    front = pareto([(row.mean("seconds") or math.inf, row.mean("psnr") or 0.0) for row in finished])
    on_front = {row.label for row, best in zip(finished, front, strict=True) if best}
    result = []
    for index, row in enumerate(rows):
        cells = [_cell(column, row, finished) for column in measured(rows)] if row.runs else []
        result.append(
            {
                "label": row.label,
                "color": plots.color_of(index),
                "front": row.label in on_front,
                "cells": cells,
                "instead": "failed" if row.failures else "not run",
            }
        )
    return result


def console_table(rows: Sequence[Row]) -> Table:
    """Return the table of `rows` for a terminal, with a line for each measurement, because labels are long."""
    result = Table("", *(row.label for row in rows))
    columns = measured(rows)
    cells = [row["cells"] or [Cell(row["instead"])] * len(columns) for row in table(rows)]
    for column, figures in zip(columns, zip(*cells, strict=True), strict=True):
        result.add_row(column.title, *(cell.text for cell in figures))
    return result


def _cell(column: Column, row: Row, rows: Sequence[Row]) -> Cell:
    value, spread = row.mean(column.figure), row.deviation(column.figure)
    if value is None:
        return Cell("–")
    text = column.show(value) + (f" ± {column.show(spread)}" if spread is not None and column.figure == "psnr" else "")
    others = [other for other in (r.mean(column.figure) for r in rows) if other is not None]
    if column.best is None or len(others) < 2:
        return Cell(text)
    return Cell(text, _best(column, value, others))


def _best(column: Column, value: float, others: Sequence[float]) -> bool:
    """Return whether a value is the best of its column; False if all are equal."""
    assert column.best is not None
    equal_to_best = [math.isclose(other, column.best(others), rel_tol=column.same) for other in others]
    return not all(equal_to_best) and math.isclose(value, column.best(others), rel_tol=column.same)


def levels(rows: Sequence[Row]) -> list[int]:
    """Return the integer PSNRs, dB, that `rows` reached after their first evaluation; at most the highest sixteen."""
    reached = {level for row in rows for run in row.runs for level in run.seconds_to}
    return sorted(reached)[-16:]


def level_table(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Return the table of the seconds of training of `rows` to each of `levels`."""
    result = []
    for index, row in enumerate(rows):
        cells = [Cell(_when(row, level)) for level in levels(rows)]
        result.append({"label": row.label, "color": plots.color_of(index), "cells": cells})
    return result


def _when(row: Row, level: int) -> str:
    """Return the time when a contender reached a PSNR, as text."""
    if (time := row.seconds_to(level)) is not None:
        return f"{time:.1f}"
    return "–" if (before := row.seconds_before(level)) is None else f"< {before:.1f}"


def machines(runs: Sequence[Measured]) -> list[str]:
    """Return a description of each machine used for `runs`."""
    lines = []
    for run in runs:
        line = ", ".join(f"{name}: {value}" for name, value in run.machine.items() if value is not None)
        if line not in lines:
            lines.append(line)
    return lines


def markdown(content: dict[str, Any]) -> str:
    """Return the report's `content` as Markdown, without images."""
    lines = [f"# {content['title']}", "", content["when"], "", *(f"- {line}" for line in content["conditions"]), ""]
    lines += _markdown_table(["method", *content["columns"]], content["rows"])
    lines += [
        "",
        "Bold: best. *: no other method had a higher PSNR after as little training (times within 1 % count as equal).",
        "",
    ]
    if content["levels"]:
        lines += ["Seconds of training to PSNR on the validation views (<: exceeded at the first evaluation):", ""]
        lines += _markdown_table(["method", *(f"{level} dB" for level in content["levels"])], content["level_rows"])
        lines.append("")
    for label, reason in content["failures"]:
        lines.append(f"- **{label} failed**: {reason}")
    lines += ["", "Commands:", "", "```", *(detail["run"].command for detail in content["details"]), "```", ""]
    lines += [f"Machine: {line}" for line in content["machines"]]
    return "\n".join(lines) + "\n"


def _markdown_table(head: list[str], rows: list[dict[str, Any]]) -> list[str]:
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for row in rows:
        name = row["label"].replace("|", "\\|") + ("*" if row.get("front") else "")
        cells = [f"**{cell.text}**" if cell.best else cell.text for cell in row["cells"]]
        lines.append("| " + " | ".join([name, *(cells or [row["instead"]] + [""] * (len(head) - 2))]) + " |")
    return lines


QUALITY = (
    *("psnr", "ssim", "ms_ssim", "lpips", "floaters", "normal_mae", "diffuse_psnr"),
    *("chamfer", "f_score", "normal_error", "faces"),
)
"""Measures of the rendered views and of the surface."""
CSV_FIGURES = ("label", "method", "seed", *QUALITY, "views", "steps", "seconds", "rays_per_second")
"""First columns of results.csv."""
CSV_MORE = ("render_seconds", "peak_memory_bytes", "parameters", "skipped_steps", "command")
"""Further columns of results.csv."""


def _csv(runs: Sequence[Measured]) -> str:
    reached = sorted({level for run in runs for level in run.seconds_to})
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow([*CSV_FIGURES, *CSV_MORE, *(f"seconds to {level} dB" for level in reached)])
    for run in runs:
        times = [run.seconds_to.get(level) for level in reached]
        writer.writerow([*(getattr(run, name) for name in (*CSV_FIGURES, *CSV_MORE)), *times])
    return file.getvalue()
