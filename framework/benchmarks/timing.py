"""Times of two implementations in alternating runs, so that a drift of the machine's speed affects both."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

import torch
from torch import Tensor


def now() -> float:
    """Return the time in seconds, after waiting for all work on the GPU."""
    if torch.cuda.is_initialized():
        torch.cuda.synchronize()
    return time.perf_counter()


Run = Callable[[], Sequence[float]]
"""Function that does some work once and returns the seconds of each of its stages."""


@dataclass(frozen=True)
class Times:
    """Times of two implementations."""

    compiled: list[float]
    """Median seconds of each stage of the first."""
    reference: list[float]
    """Median seconds of each stage of the second."""
    speed_up: float
    """Median ratio of the second's time to the first's, over neighbouring runs with all stages."""


def alternating(compiled: Run, reference: Run, repeats: int) -> Times:
    """Run `compiled` and `reference` in turn, `repeats` times each, after a warm-up run of each."""
    runs = [(compiled(), reference()) for _ in range(repeats + 1)][1:]
    ours, theirs = zip(*runs, strict=True)
    ratios = [sum(their) / sum(our) for our, their in runs]
    return Times(_medians(ours), _medians(theirs), median(ratios))


def _medians(runs: Sequence[Sequence[float]]) -> list[float]:
    return [median(stage) for stage in zip(*runs, strict=True)]


def once(run: Callable[[], Any]) -> Run:
    """Return a measurement of `run` as one stage."""

    def timed() -> list[float]:
        start = now()
        run()
        return [now() - start]

    return timed


def differentiated(
    function: Callable[..., Tensor], inputs: Sequence[Tensor], gradient: Tensor | None, backward: bool = True
) -> Run:
    """Return a measurement of a function of tensors, with the stages forward and backward.

    Args:
        function: the function.
        inputs: its arguments, which require gradients.
        gradient: gradient of the function's value; None for ones.
        backward: whether to run the backward stage.
    """

    def timed() -> list[float]:
        leaves = [tensor.clone().requires_grad_(backward) for tensor in inputs]
        start = now()
        value = function(*leaves)
        middle = now()
        if not backward:
            return [middle - start]
        (value.sum() if gradient is None else value).backward(gradient)
        return [middle - start, now() - middle]

    return timed
