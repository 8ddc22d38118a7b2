"""Compositing of alphas, the opacities of samples of a surface (NeuS, Wang et al. 2021, equation 10).

    T_i = prod_{j < i} (1 - alpha_j)            transmittance in front of a sample
    w_i = T_i alpha_i                           weight

An alpha is equivalent to the optical depth tau = -log(1 - alpha) of an interval of length 1, so alphas are composited
as densities.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from nerfloom.geometry.rays import Samples
from nerfloom.kernels.compositing.density import Composited, composite
from nerfloom.kernels.math import at_least_float32

LEFT_BEHIND = 4e-4
"""Maximum transmittance behind a sample with an alpha of 1, in float32 (`alpha_depth`)."""


def alpha_depth(alpha: Tensor) -> Tensor:
    """Return the optical depth (N,) -log(1 - alpha). It is finite at 1, as is its gradient; NaN stays NaN.

    An alpha within sqrt(eps) of 1 (3.5e-4 in float32) is replaced by 1 - sqrt(eps), with the gradient of the identity.
    Closer to 1 the factor 1 / (1 - alpha) would amplify the rounding errors of the composited sums in the gradient.

    Args:
        alpha: (N,) in [0, 1].

    Returns:
        Optical depth (N,), float64 if `alpha` is float64, and float32 otherwise.
    """
    alpha = at_least_float32(alpha)
    most = 1 - torch.finfo(alpha.dtype).eps ** 0.5
    return -torch.log1p(-(alpha - (alpha - alpha.clamp(max=most)).detach()))


def unit_intervals(samples: Samples, alpha: Tensor) -> tuple[Samples, Tensor]:
    """Convert alphas to densities of intervals of length 1 with the same opacity.

    Args:
        samples: N samples.
        alpha: (N,) opacity of each sample in [0, 1].

    Returns:
        The samples with such intervals and their previous t, and the density (N,).
    """
    depth = alpha_depth(alpha)
    t = samples.t
    return replace(samples, t_starts=torch.zeros_like(t), t_ends=torch.ones_like(t), points=t), depth


def composite_alpha(samples: Samples, alpha: Tensor, rgb: Tensor, background: Tensor, fars: Tensor) -> Composited:
    """Composite packed samples with alphas.

    Weights differ from the products T_i alpha_i by at most sqrt(eps) of the type of `alpha` (3.5e-4 in float32).
    `rgb`, `background`, `fars`, the result and errors are as in `composite`.

    Args:
        samples: N samples of R rays; only their order and t are used.
        alpha: (N,) opacity of each sample in [0, 1].
    """
    return composite(*unit_intervals(samples, alpha), rgb, background, fars)
