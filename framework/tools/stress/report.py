"""What became of one method or several: with which settings they ran, and a table of conditions by methods."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from framework.base.config import to_plain
from framework.base.registry import load_method
from framework.data.scene import Scene
from framework.tools.stress.trial import Budget, shortened
from framework.tools.stress.verdict import Verdict
from framework.training.run import Run


@dataclass(frozen=True)
class Result:
    """What became of a method."""

    method: str
    """With its flags, as it was asked for."""
    machine: dict[str, Any]
    """What it ran on: processor, threads, kernels, versions, commit (`framework.training.machine`)."""
    settings: dict[str, Any]
    """Of its plain run."""
    verdicts: tuple[Verdict, ...]
    """One for each condition, in their order."""


def settings_of(run: Run, budget: Budget, scene: Scene) -> dict[str, Any]:
    """Return the plain run's settings as plain values, less those that name files and folders of a machine.

    Args:
        run: the method and its settings.
        budget: how long it trains.
        scene: facts about the plain images.
    """
    method = load_method(run.method)
    config = shortened(run.config, budget, method, scene)
    config, _ = method.decide(config, scene)
    return {name: value for name, value in to_plain(config).items() if not isinstance(getattr(config, name), Path)}


def table(results: Sequence[Result]) -> list[list[str]]:
    """Rows of text: the methods' names, then for each condition what each method made of it (`Verdict.cell`)."""
    rows = [["condition", *(result.method for result in results)]]
    for row in zip(*(result.verdicts for result in results), strict=True):
        rows.append([row[0].name, *(verdict.cell() for verdict in row)])
    return rows


def notes(results: Sequence[Result]) -> list[str]:
    """Why what is no pass is none, in a line each."""
    return [
        f"{result.method}, {verdict.name}: {verdict.outcome}: {verdict.error or verdict.reason}"
        for result in results
        for verdict in result.verdicts
        if verdict.outcome != "pass"
    ]


def markdown(results: Sequence[Result]) -> str:
    """The table, the notes, and what it all ran on, to be put into a document."""
    head, *body = table(results)
    rows = "\n".join(_row(cells) for cells in (head, ["---"] * len(head), *body))
    lines = "\n".join(f"- {note}" for note in notes(results))
    on = results[0].machine
    where = f"{on['processor']}, {on['device']}, {on['threads']} threads, {on['kernels']} kernels"
    version = f"torch {on['torch']}, nerfloom {on['nerfloom']}" + (f" at {on['commit']}" if on["commit"] else "")
    return "\n\n".join(filter(None, (rows, lines, f"{where}; {version}."))) + "\n"


def _row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
