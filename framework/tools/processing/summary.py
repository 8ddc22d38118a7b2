"""What a person is told at the end: how much was found, how long it took, and what to do where it is too little."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

ENOUGH = 0.8
"""Share of registered photographs below which advice is given."""


@dataclass(frozen=True)
class Summary:
    """The figures of a reconstruction."""

    photographs: int
    """Readable ones."""
    unreadable: int
    registered: int
    """Photographs of the largest model, which is kept."""
    other_models: tuple[int, ...]
    """Photographs of the other models."""
    points: int
    reprojection_error: float
    """Mean, pixels."""
    matching: str
    seconds: dict[str, float]
    """By stage."""

    def as_json(self) -> dict[str, Any]:
        """For a file beside the model."""
        return asdict(self) | {"seconds": {stage: round(value, 2) for stage, value in self.seconds.items()}}


def lines(summary: Summary) -> list[str]:
    """The figures in words."""
    share = summary.registered / summary.photographs
    stages = ", ".join(f"{stage} {seconds:.1f} s" for stage, seconds in summary.seconds.items())
    said = [
        f"registered: {summary.registered} of {summary.photographs} photographs ({share:.0%}); "
        f"{summary.points} points; mean reprojection error {summary.reprojection_error:.2f} pixels",
        f"time: {sum(summary.seconds.values()):.1f} s ({stages})",
    ]
    if summary.other_models:
        sizes = ", ".join(map(str, summary.other_models))
        said.append(f"left out: {len(summary.other_models)} other models that do not connect, of {sizes} photographs")
    if share < ENOUGH:
        said.append(f"few photographs were registered. {advice(summary.matching)}")
    return said


def advice(matching: str) -> str:
    """What to do where photographs do not connect."""
    steps = [
        "take photographs with more overlap (two thirds or more with the next one), sharp, in steady light",
        "give --max-num-features 16384 and --max-image-size 3200",
    ]
    if matching != "exhaustive":
        steps.append("give --matching-method exhaustive")
    if matching == "sequential":
        steps.append("take more frames (--num-frames-target, or a larger --sequential-overlap)")
    return "To do better: " + "; ".join(steps) + "."
