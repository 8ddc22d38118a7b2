"""Results of stress tests: the settings of each method, and a table of conditions by methods."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nerfloom.base.plain import to_plain
from nerfloom.data.scene import Scene
from nerfloom.registry import load_method
from nerfloom.stress.trial import Budget, shortened
from nerfloom.stress.verdict import Verdict
from nerfloom.training.run import Run


@dataclass(frozen=True)
class Result:
    """Outcomes of a method under all conditions."""

    method: str
    """Name of the method, with its flags."""
    machine: dict[str, Any]
    """Processor, threads, kernels, versions and commit (`nerfloom.training.machine`)."""
    settings: dict[str, Any]
    """Settings of the plain run."""
    verdicts: tuple[Verdict, ...]
    """Verdict of each condition, in the order of the conditions."""


def settings_of(run: Run, budget: Budget, scene: Scene) -> dict[str, Any]:
    """Return the settings of the plain `run` on `scene` within `budget` as plain values, without paths."""
    method = load_method(run.method)
    config = shortened(run.config, budget, method, scene)
    config, _ = method.decided(config, scene)
    return {name: value for name, value in to_plain(config).items() if not isinstance(getattr(config, name), Path)}


def table(results: Sequence[Result]) -> list[list[str]]:
    """Return rows of text: the methods of `results`, then each condition with a `Verdict.cell` per method."""
    rows = [["condition", *(result.method for result in results)]]
    for row in zip(*(result.verdicts for result in results), strict=True):
        rows.append([row[0].name, *(verdict.cell() for verdict in row)])
    return rows


def notes(results: Sequence[Result]) -> list[str]:
    """Return a line with the reason for each verdict of `results` other than pass."""
    return [
        f"{result.method}, {verdict.name}: {verdict.outcome}: {verdict.error or verdict.reason}"
        for result in results
        for verdict in result.verdicts
        if verdict.outcome != "pass"
    ]


def markdown(results: Sequence[Result]) -> str:
    """Return the table, the notes and the machine of `results`, as Markdown."""
    head, *body = table(results)
    rows = "\n".join(_row(cells) for cells in (head, ["---"] * len(head), *body))
    lines = "\n".join(f"- {note}" for note in notes(results))
    facts = results[0].machine
    hardware = f"{facts['processor']}, {facts['device']}, {facts['threads']} threads, {facts['kernels']} kernels"
    commit = f" at {facts['commit']}" if facts["commit"] else ""
    version = f"torch {facts['torch']}, nerfloom {facts['nerfloom']}{commit}"
    return "\n\n".join(filter(None, (rows, lines, f"{hardware}; {version}."))) + "\n"


def _row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
