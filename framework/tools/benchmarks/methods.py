"""Time to each PSNR of the built-in methods, on the embedded scene or on a data set: the standard comparison."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from framework.base.console import say
from framework.tools.comparison import plots
from framework.tools.comparison.measures import Row, read_json
from framework.tools.comparison.plan import Conditions, Contender, Plan

STANDARD = (
    "instant-ngp",
    "nerfacto",
    "kplanes",
    "tensorf",
    "vanilla-nerf --sampler occupancy",
    "dnerf --sampler occupancy --canonical hash-grid",
)
"""Every built-in method, as it is meant to be used on a processor."""


def standard_plan(data: Path | None, max_seconds: float, repeats: int, folder: Path) -> Plan:
    """The standard comparison on a data set; on the embedded scene if None."""
    conditions = Conditions(
        data=None if data is None else str(data.resolve()),
        data_flags=(),
        max_seconds=max_seconds,
        max_num_iterations=None,
        target_psnr=None,
        num_threads=None,
        device_type="auto",
        curve_images=4,
        max_eval_images=None,
    )
    return Plan(tuple(map(Contender.of, STANDARD)), conditions, repeats, folder.resolve())


def published(folder: Path) -> dict[str, Any]:
    """A comparison's results without what only means something on the machine that made them."""
    content = read_json(folder / "results.json") or {}
    conditions = {**content["conditions"], "data": Path(content["conditions"]["data"] or "procedural").name}
    runs = [{name: value for name, value in run.items() if name != "folder"} for run in content["runs"]]
    for run in runs:
        run["command"] = run["command"].replace(content["conditions"]["data"] or "\0", "DIR")
    return {**content, "conditions": conditions, "runs": runs}


def draw(rows: Sequence[Row], path: Path) -> None:
    """The report's picture of time against error, as a file of its own; where it cannot be drawn, that is said."""
    if not any(row.runs for row in rows):
        say("no picture of time against error: no method came to its end")
    elif not plots.available():
        say(plots.MISSING)
    else:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(plots.time_against_error(rows), encoding="utf-8")
