"""Outcomes of many inputs, in lines for people and as plain data."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from importlib.metadata import version
from typing import Any

from tests.fuzz.outcome import Outcome

LIBRARIES = ("numpy", "pillow", "imageio", "PyYAML", "pycolmap")
"""Libraries that read files for us, besides torch."""


def by_reader(outcomes: Sequence[Outcome]) -> dict[str, list[Outcome]]:
    """Outcomes of each reader."""
    found: dict[str, list[Outcome]] = {}
    for outcome in outcomes:
        found.setdefault(outcome.reader, []).append(outcome)
    return found


def counts(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Numbers of inputs of a reader, of their outcomes and of different ones, and the first and the last seed."""
    kinds, seeds = Counter(outcome.kind for outcome in outcomes), [outcome.seed for outcome in outcomes]
    return {
        "inputs": len(outcomes),
        "accepted": kinds["accepted"],
        "refused": kinds["refused"],
        "escaped": kinds["escaped"],
        "unique_outcomes": len({(outcome.kind, outcome.error, outcome.shape) for outcome in outcomes}),
        "seeds": [min(seeds), max(seeds)],
    }


def summary(outcomes: Sequence[Outcome]) -> list[str]:
    """Lines: numbers of inputs by outcome, and each kind of answer once, the most frequent first."""
    lines = []
    for reader, own in by_reader(outcomes).items():
        shapes = Counter((outcome.error, outcome.shape) for outcome in own if outcome.kind == "refused")
        found = counts(own)
        became = f"{found['accepted']} accepted, {found['refused']} refused in {len(shapes)} ways"
        lines.append(f"{reader}: {found['inputs']} inputs, {became}, {found['escaped']} escaped")
        lines += [f"  {number:6,} {error}: {shape}" for (error, shape), number in shapes.most_common()]
    return lines


def as_plain(outcomes: Sequence[Outcome], seconds: float) -> dict[str, Any]:
    """For JSON: counts, the escapes in full, and the versions of libraries."""
    from nerfloom.training.machine import machine  # brings torch

    readers = {reader: counts(own) for reader, own in by_reader(outcomes).items()}
    totals = {key: sum(found[key] for found in readers.values()) for key in ("inputs", "unique_outcomes", "escaped")}
    return {
        **totals,
        "seconds": round(seconds, 1),
        "readers": readers,
        "escapes": [asdict(outcome) for outcome in outcomes if outcome.kind == "escaped"],
        "libraries": {name: version(name) for name in LIBRARIES},
        "machine": machine(),
    }
