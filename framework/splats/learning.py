"""The number of Gaussians, their learning rates and the times of their growth, from the budget."""

from __future__ import annotations

import math

from nerfloom.splats.gaussians import MAX_DEGREE

USUAL_STEPS = 30_000
"""Number of steps that the learning rates of 3D Gaussian Splatting are made for."""

MAX_MOVES = 16
"""Maximum number of changes planned for a run. With more, a capture of 2,000 steps got half again as many Gaussians and
no better images."""
MIN_STEPS, MAX_STEPS = 20, 100
"""Minimum and maximum number of steps between two changes of the number of Gaussians."""


def number_for(seconds: float, most: int) -> int:
    """Return the number of Gaussians, at most `most`, that suits a budget of `seconds`."""
    return int(min(max(8_000 * math.sqrt(seconds), 20_000), most))


def rate_factor(steps: float, most: float) -> float:
    """Return the factor of learning rates for `steps` steps, at most `most`: shorter runs have a larger one."""
    return min(max((USUAL_STEPS / steps) ** 0.44, 1.0), most)


def steps_per_move(steps: float, first: int, most: int, per_doubling: float) -> int:
    """Return the number of steps between changes of the number of Gaussians. Short runs have fewer.

    Args:
        steps: steps of the run during growth.
        first: number of Gaussians at the start.
        most: maximum number.
        per_doubling: approximate number of changes that double the number (`Strategy.changes_per_doubling`).
    """
    doublings = math.log2(max(most / max(first, 1), 1.0))
    moves = min(max(per_doubling * doublings, 1.0), MAX_MOVES)
    return int(min(max(steps / moves, MIN_STEPS), MAX_STEPS))


def open_degree(progress: float) -> int:
    """Return the highest degree of harmonics in use; all are in use after half of the budget.

    Args:
        progress: share of the budget that is spent.
    """
    return min(int(2 * (MAX_DEGREE + 1) * progress), MAX_DEGREE)
