"""Time to each PSNR of the built-in methods, on the embedded scene or on a data set: the standard comparison."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from nerfloom.base.console import say
from nerfloom.comparison import plots
from nerfloom.comparison.measures import Row, read_json
from nerfloom.comparison.plan import Conditions, Contender, Plan

STANDARD = (
    "instant-ngp",
    "nerfacto",
    "kplanes",
    "tensorf",
    "vanilla-nerf --sampler occupancy",
    "dnerf --sampler occupancy --canonical hash-grid",
)
"""All built-in methods, with their recommended flags for a CPU."""


def standard_plan(data: Path | None, max_seconds: float, repeats: int, folder: Path) -> Plan:
    """Return the plan of the standard comparison.

    Args:
        data: folder of the data set; the embedded scene if None.
        max_seconds: seconds of training of each method.
        repeats: number of runs of each method, with different seeds.
        folder: folder of runs and report.
    """
    conditions = Conditions(None if data is None else str(data.resolve()), max_seconds=max_seconds)
    return Plan(tuple(map(Contender.of, STANDARD)), conditions, repeats, folder.resolve())


def published(folder: Path) -> dict[str, Any]:
    """Return the results of the comparison in `folder`, without paths of the machine."""
    content = read_json(folder / "results.json") or {}
    conditions = {**content["conditions"], "data": Path(content["conditions"]["data"] or "procedural").name}
    runs = [{name: value for name, value in run.items() if name != "folder"} for run in content["runs"]]
    for run in runs:
        run["command"] = run["command"].replace(content["conditions"]["data"] or "\0", "DIR")
    return {**content, "conditions": conditions, "runs": runs}


def draw(rows: Sequence[Row], path: Path) -> None:
    """Write the report's plot of `rows` to the file `path`, in a folder that is made if missing, or report why not."""
    if not any(row.runs for row in rows):
        say("no plot of time against error: no method finished")
    elif not plots.available():
        say(plots.MISSING)
    else:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(plots.time_against_error(rows), encoding="utf-8")
