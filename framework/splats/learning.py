"""Numbers that a budget decides of Gaussians that learn: how many, how fast, and when there come more."""

from __future__ import annotations

import math

from nerfloom.splats.gaussians import MAX_DEGREE

USUAL_STEPS = 30_000
"""Steps of a run of 3D Gaussian Splatting, for which its learning rates are."""

MOST_MOVES = 16
"""Maximum number of changes that are wanted in a run. More gave a capture of 2,000 steps half as many Gaussians again,
and no better images."""
FEWEST_STEPS, MOST_STEPS = 20, 100
"""Least and most steps between two changes of the number of Gaussians."""


def number_for(seconds: float, most: int) -> int:
    """Return the number of Gaussians, at most `most`, that suits a budget of `seconds`."""
    return int(min(max(8_000 * math.sqrt(seconds), 20_000), most))


def rate_factor(steps: float, most: float) -> float:
    """Return the factor, at most `most`, of learning rates in a run of so many `steps`: fewer have to go farther."""
    return min(max((USUAL_STEPS / steps) ** 0.44, 1.0), most)


def steps_per_move(steps: float, first: int, most: int, per_doubling: float) -> int:
    """Return after how many steps the number of Gaussians changes, so that there are changes enough in a short run.

    Args:
        steps: steps of the run during growth.
        first: number of Gaussians at the start.
        most: maximum number.
        per_doubling: changes that double the number, about (`Strategy.changes_per_doubling`).
    """
    doublings = math.log2(max(most / max(first, 1), 1.0))
    moves = min(max(per_doubling * doublings, 1.0), MOST_MOVES)
    return int(min(max(steps / moves, FEWEST_STEPS), MOST_STEPS))


def open_degree(progress: float) -> int:
    """Return the degree up to which harmonics count; all do after half of the budget.

    Args:
        progress: share of the budget that is spent.
    """
    return min(int(2 * (MAX_DEGREE + 1) * progress), MAX_DEGREE)
