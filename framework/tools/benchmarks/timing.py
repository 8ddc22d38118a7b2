"""Times of two ways to do the same, in alternating runs: a machine whose speed drifts disturbs neighbours alike."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

from torch import Tensor

Run = Callable[[], Sequence[float]]
"""Does something once. Returns: the seconds of each of its stages."""


@dataclass(frozen=True)
class Times:
    """Of both ways."""

    compiled: list[float]
    """Median seconds of each stage."""
    reference: list[float]
    speed_up: float
    """Median of the ratios of neighbouring runs, all stages together."""


def alternating(compiled: Run, reference: Run, repeats: int) -> Times:
    """Run both in turn, so many times each after one to warm up."""
    runs = [(compiled(), reference()) for _ in range(repeats + 1)][1:]
    ours, theirs = zip(*runs, strict=True)
    ratios = [sum(their) / sum(our) for our, their in runs]
    return Times(_medians(ours), _medians(theirs), median(ratios))


def _medians(runs: Sequence[Sequence[float]]) -> list[float]:
    return [median(stage) for stage in zip(*runs, strict=True)]


def once(run: Callable[[], Any]) -> Run:
    """Something of one stage."""

    def timed() -> list[float]:
        start = time.perf_counter()
        run()
        return [time.perf_counter() - start]

    return timed


def differentiated(
    function: Callable[..., Tensor], inputs: Sequence[Tensor], gradient: Tensor | None, backward: bool = True
) -> Run:
    """A function of tensors forward and, as a second stage, backward.

    Args:
        inputs: its arguments, of which derivatives are taken.
        gradient: of the value; ones if None.
        backward: whether there is a second stage.
    """

    def timed() -> list[float]:
        leaves = [tensor.clone().requires_grad_(backward) for tensor in inputs]
        start = time.perf_counter()
        value = function(*leaves)
        middle = time.perf_counter()
        if not backward:
            return [middle - start]
        (value.sum() if gradient is None else value).backward(gradient)
        return [middle - start, time.perf_counter() - middle]

    return timed
