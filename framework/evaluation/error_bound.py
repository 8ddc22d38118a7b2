"""Faster rendering within an error bound: a ray ends where the rest can change a colour by at most the bound."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from nerfloom.base.console import track
from nerfloom.base.errors import ConfigError, FlagError
from nerfloom.base.evenly_spaced import strided
from nerfloom.data.dataset import Dataset
from nerfloom.evaluation.evaluator import timed_view
from nerfloom.renderable import Renderable, parts
from nerfloom.samplers.base import StopsEarly

MAX_VIEWS = 4
"""Maximum number of views used to measure the error."""


def parse_error(text: str) -> float:
    """Return the error bound given as `text`, such as 0.004 or 1/255.

    Raises:
        ConfigError: if it is not a number in [0, 1).
    """
    try:
        numerator, _, denominator = text.partition("/")
        bound = float(numerator) / (float(denominator) if denominator else 1.0)
    except (ValueError, ZeroDivisionError):
        bound = -1.0
    if not 0 <= bound < 1:
        raise FlagError(f"--max-error is '{text}'; it must be a number from 0 to less than 1, such as 0.004 or 1/255")
    return bound


@contextmanager
def limited_error(model: Renderable, bound: float) -> Iterator[None]:
    """End rays of `model` at a transmittance `bound` in [0, 1), within a `with` block.

    The rest of a ray changes a colour by at most as much.
    """
    samplers = parts(model, StopsEarly)
    if not samplers:
        raise ConfigError("--max-error: this run has no occupancy grid to end its rays early; leave out the flag")
    before = [sampler.early_stop for sampler in samplers]
    try:
        for sampler in samplers:
            sampler.early_stop = bound
        yield
    finally:
        for sampler, stop in zip(samplers, before, strict=True):
            sampler.early_stop = stop


def measured_error(model: Renderable, dataset: Dataset, bound: float) -> tuple[float, float]:
    """Measure the error and the speed-up of rendering with an error bound, on a few views.

    Args:
        model: the model.
        dataset: views, on the model's device.
        bound: transmittance where rays end.

    Returns:
        The maximum difference of a colour channel from rendering without early stop, and the ratio of the two times.
    """
    background, worst, times = model.background, 0.0, [0.0, 0.0]
    chosen = strided(len(dataset), MAX_VIEWS)
    for index in track(chosen, "Measuring the error", total=len(chosen)):
        views = []
        for number, stop in enumerate((0.0, bound)):
            with limited_error(model, stop):
                picture, seconds = timed_view(model, dataset.view(index), background)
            views.append(picture)
            times[number] += seconds
        worst = max(worst, float((views[0].rgb - views[1].rgb).abs().max()))
    return worst, times[0] / times[1]
