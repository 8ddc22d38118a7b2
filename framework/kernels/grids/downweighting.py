"""Weights of a grid's levels for points with a size: Zip-NeRF (Barron et al. 2023), section 3.1."""

from __future__ import annotations

import torch
from torch import Tensor

MIN_DEVIATION = 0.05
"""Below this standard deviation, in cells, a weight is 1: erf(1 / (sqrt(8) 0.05)) differs from 1 by 2e-23."""


def level_weights(deviations: Tensor, resolutions: Tensor) -> Tensor:
    """Return the factors of the features of each level of a grid, for isotropic Gaussians.

    The factor is erf(1 / sqrt(8 s^2 n^2)), the fraction of a Gaussian along an axis that lies within half a cell of its
    mean. It is 1 for Gaussians much smaller than the cells of a level, and 0 for Gaussians that cover many cells.

    Args:
        deviations: (N,) standard deviation s of each Gaussian, in units of the domain [0, 1] of the grid; at least 0,
            and possibly infinite.
        resolutions: (L,) number n of cells along an axis, for each level.

    Returns:
        (N, L) factors in [0, 1]; float64 if `deviations` is float64, and float32 otherwise. A NaN stays NaN.
    """
    deviations = deviations if deviations.dtype == torch.float64 else deviations.float()
    # The bound changes no value; without it the gradient would be infinity times 0 at s = 0.
    cells = (deviations[:, None] * resolutions.to(deviations)).clamp(min=MIN_DEVIATION)
    return torch.erf(8**-0.5 / cells)
