"""Rendering faster within a stated error: rays end where the rest cannot change a colour by more than that."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from framework.base.errors import ConfigError
from framework.data.dataset import Dataset
from framework.evaluation.evaluator import evaluation_background, spread, timed_view
from framework.model import Model, parts
from framework.samplers.base import StopsEarly

MEASURED_VIEWS = 4


def parse_error(text: str) -> float:
    """A bound such as 0.004 or 1/255.

    Raises: ConfigError where it is not a number from 0 to below 1.
    """
    try:
        numerator, _, denominator = text.partition("/")
        bound = float(numerator) / (float(denominator) if denominator else 1.0)
    except (ValueError, ZeroDivisionError):
        bound = -1.0
    if not 0 <= bound < 1:
        raise ConfigError(f"--max-error is '{text}'; it must be a number from 0 to below 1, such as 0.004 or 1/255")
    return bound


@contextmanager
def limited_error(model: Model[Any], bound: float) -> Iterator[None]:
    """Render with rays that end at transmittance `bound`: what is cut off could add at most bound * (1 - 0).

    Raises: ConfigError for a method whose rays do not end early.
    """
    samplers = parts(model, StopsEarly)
    if not samplers:
        raise ConfigError("--max-error: this run has no occupancy grid to stop its rays early; leave it out")
    before = [sampler.early_stop for sampler in samplers]
    try:
        for sampler in samplers:
            sampler.early_stop = bound
        yield
    finally:
        for sampler, stop in zip(samplers, before, strict=True):
            sampler.early_stop = stop


def measured_error(model: Model[Any], dataset: Dataset, bound: float) -> tuple[float, float]:
    """Largest difference of a colour channel to rendering without early stop, over a few views, and the speed-up."""
    background, worst, times = evaluation_background(model), 0.0, [0.0, 0.0]
    for index in spread(len(dataset), MEASURED_VIEWS):
        views = []
        for place, stop in enumerate((0.0, bound)):
            with limited_error(model, stop):
                picture, seconds = timed_view(model, dataset.view(index), background)
            views.append(picture)
            times[place] += seconds
        worst = max(worst, float((views[0].rgb - views[1].rgb).abs().max()))
    return worst, times[0] / times[1]
