"""Values within limits, with a slope of 1 up to the limits themselves.

torch's own clamp has that slope at a limit up to version 2.13, and 0 from 2.14 on. The slope matters for values on a
limit: positions on the faces of a box, and vectors along an axis, which have the scaled length 1.
"""

from __future__ import annotations

import torch
from torch import Tensor


def at_least(x: Tensor, low: float) -> Tensor:
    """Return the larger of `x` and `low`; NaN stays NaN."""
    return torch.where(x < low, low, x)


def between(x: Tensor, low: float, high: float) -> Tensor:
    """Return `x` where it lies between `low` and `high`, and the nearer of them elsewhere; NaN stays NaN."""
    return torch.where(x > high, high, torch.where(x < low, low, x))
