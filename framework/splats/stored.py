"""Values of Gaussians as files of several formats store them."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from nerfloom.kernels.splats.project import DC

MIN_DEVIATION = 1e-30
"""Standard deviation that replaces 0, so that the logarithm is finite."""


def as_float32(values: np.ndarray) -> Tensor:
    """Return `values` of any type in float32; those beyond its range become infinite."""
    with np.errstate(over="ignore", invalid="ignore"):
        return torch.from_numpy(np.require(values, np.float32, ("C", "W")))


def logits_of_bytes(opacity: np.ndarray) -> Tensor:
    """Return the logits (N,) of `opacity` (N,) from 0 to 255.

    0 and 255 become 1/1020 and 1019/1020, the centres of the intervals that round to them, because their own logits are
    infinite.
    """
    share = opacity.astype(np.float64).clip(0.25, 254.75) / 255
    return as_float32(np.log(share / (1 - share)))


def colors_of_bytes(colors: np.ndarray) -> Tensor:
    """Return the coefficients of degree 0 (N, 3) of `colors` (N, 3) from 0 to 255."""
    return as_float32((colors.astype(np.float64) / 255 - 0.5) / DC)


def log_scales_of(deviations: np.ndarray) -> Tensor:
    """Return the logarithms (N, 3) of standard `deviations` (N, 3); they are NaN for negative ones."""
    deviations = deviations.astype(np.float64)
    with np.errstate(invalid="ignore"):
        return as_float32(np.log(np.where(deviations == 0, MIN_DEVIATION, deviations)))
