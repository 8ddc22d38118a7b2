"""Gaussians that learn: what a budget decides, and their parameters as tables that an optimiser changes row by row."""

from __future__ import annotations

import math
from collections.abc import Sequence

from torch import Tensor, nn

from nerfloom.base.optimised import RowChange
from nerfloom.splats.gaussians import MAX_DEGREE, Gaussians

USUAL_STEPS = 30_000
"""Steps of a run of 3D Gaussian Splatting, for which its learning rates are."""

MOVES_PER_DOUBLING = {"adc": 5, "mcmc": 15}
"""Changes that double the number of Gaussians, about, by strategy: growth by gradients was seen to need 4.5 to 6, and
the other strategy adds 5 % at a time."""
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


def steps_per_move(steps: float, first: int, most: int, strategy: str) -> int:
    """Return after how many steps the number of Gaussians changes, so that there are changes enough in a short run.

    Args:
        steps: steps of the run during growth.
        first: number of Gaussians at the start.
        most: maximum number.
        strategy: how they come and go.
    """
    doublings = math.log2(max(most / max(first, 1), 1.0))
    moves = min(max(MOVES_PER_DOUBLING[strategy] * doublings, 1.0), MOST_MOVES)
    return int(min(max(steps / moves, FEWEST_STEPS), MOST_STEPS))


def open_degree(progress: float) -> int:
    """Return the degree up to which harmonics count; all do after half of the budget.

    Args:
        progress: share of the budget that is spent.
    """
    return min(int(2 * (MAX_DEGREE + 1) * progress), MAX_DEGREE)


def as_gaussians(tables: Sequence[Tensor], unit: Tensor | float = 1.0) -> Gaussians:
    """Return the Gaussians whose parameters are in tables.

    Args:
        tables: six of (N, width), in the order of `Gaussians`.
        unit: length in which centres are stored, scene units.
    """
    means, log_scales, rotations, logits, colors, harmonics = tables
    shaped = harmonics.view(len(means), 3, harmonics.shape[1] // 3)
    return Gaussians(means * unit, log_scales, rotations, logits[:, 0], colors, shaped)


def as_tables(gaussians: Gaussians, unit: Tensor | float = 1.0) -> list[Tensor]:
    """Return the parameters of N Gaussians as six tables (N, width): the inverse of `as_gaussians`.

    Args:
        gaussians: N Gaussians.
        unit: length in which centres are stored, scene units.
    """
    g = gaussians
    return [g.means / unit, g.log_scales, g.rotations, g.logits[:, None], g.colors, g.harmonics.flatten(1)]


def row_changes(
    tables: Sequence[nn.Parameter], kept: Tensor, fresh: Gaussians, unit: Tensor | float = 1.0
) -> list[RowChange]:
    """Return the changes of tables by which some Gaussians stay, and others are added behind them.

    Args:
        tables: six of (N, width), in the order of `Gaussians`.
        kept: (K,) int64 which of them stay.
        fresh: those that are added.
        unit: length in which centres are stored, scene units.
    """
    return [RowChange(table, kept, rows) for table, rows in zip(tables, as_tables(fresh, unit), strict=True)]
