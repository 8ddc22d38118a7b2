"""Coordinates far from the origin: whether float32 is too coarse for them, and a local origin near them."""

from __future__ import annotations

import math

from torch import Tensor

TOLERANCE = 1e-5
"""Maximum rounding error of float32 coordinates, as a fraction of their spread."""
HALF_STEP = 2.0**-24
"""Largest rounding error of a float32, as a fraction of its value."""


def rounding(points: Tensor) -> float:
    """Return the maximum float32 rounding error of coordinates in the middle of `points` (K, 3)."""
    return HALF_STEP * float(points.double().median(0).values.abs().max())


def local_origin(points: Tensor, size: float = 0.0) -> Tensor | None:
    """Return an origin (3,) float64 near the middle of points, if float32 is too coarse for them; otherwise None.

    A float32 has 24 bits: a value of 5,000,000 is rounded by up to 0.25. float32 counts as too coarse if this error
    exceeds `TOLERANCE` times the spread of the points, the median distance from their median. This happens when the
    points are more than 168 times as far from the origin as from each other. Medians ignore a few outliers.

    Args:
        points: (K, 3) positions. Positions that are not finite are ignored.
        size: typical size of the object at a point; the spread is at least this.

    Returns:
        The origin, a multiple of a power of ten along each axis, so that people can read it.
    """
    points = points[points.isfinite().all(-1)].double().cpu()
    if not len(points):
        return None
    middle = points.median(0).values
    spread = max(float((points - middle).abs().amax(-1).median()), size)
    if HALF_STEP * float(middle.abs().max()) <= TOLERANCE * spread:
        return None
    # Steps of a power of ten at most as large as the spread, but not below what float64 can add to the middle.
    step = 10.0 ** math.floor(math.log10(max(spread, 1e-9 * float(middle.abs().max()))))
    return (middle / step).round() * step
