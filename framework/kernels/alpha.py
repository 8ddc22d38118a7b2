"""Composites alphas, the share of light that each sample stops, as of a surface (NeuS, Wang et al. 2021, eq. 10).

    T_i = prod_{j < i} (1 - alpha_j)            transmittance in front of a sample
    w_i = T_i alpha_i                           weight

An alpha is the optical depth tau = -log(1 - alpha) of an interval of length 1, so densities' compositing does it.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from framework.geometry.rays import Samples
from framework.kernels.compositing import Composited, composite


def alpha_depth(alpha: Tensor) -> Tensor:
    """Compute the optical depth (N,) -log(1 - alpha), which is finite at 1, as is its gradient; NaN stays NaN.

    An alpha within sqrt(eps) of 1 (3.5e-4 in float32) is taken for 1 - sqrt(eps), with the gradient of the identity.
    Nearer to 1 the gradient of the sums, whose rounding 1 / (1 - alpha) multiplies, would lose its digits.

    Args:
        alpha: (N,) in [0, 1].
    Returns: float32, or float64 where alpha is that.
    """
    alpha = alpha if alpha.dtype == torch.float64 else alpha.float()
    most = 1 - torch.finfo(alpha.dtype).eps ** 0.5
    return -torch.log1p(-(alpha - (alpha - alpha.clamp(max=most)).detach()))


def unit_intervals(samples: Samples, alpha: Tensor) -> tuple[Samples, Tensor]:
    """Turn alphas into densities over intervals of length 1, which stop the same share of light.

    Args:
        samples: N samples.
        alpha: (N,) in [0, 1].
    Returns: the samples with such intervals and with t as it was, and their density (N,).
    """
    depth = alpha_depth(alpha)
    t = samples.t
    return replace(samples, t_starts=torch.zeros_like(t), t_ends=torch.ones_like(t), points=t), depth


def composite_alpha(samples: Samples, alpha: Tensor, rgb: Tensor, background: Tensor, fars: Tensor) -> Composited:
    """Composite N packed samples with alphas to colour, opacity and depth of R rays.

    Weights are within sqrt(eps) of their alpha's dtype (3.5e-4 in float32) of the products above.

    Args:
        samples: N samples; only their order and t matter.
        alpha: (N,) in [0, 1].
        rgb: (N, 3) colour.
        background: (R, 3) or (3,) what shows where a ray is not opaque.
        fars: (R,) the rays' far ends.
    Raises: IndexError where the samples' offsets do not divide them between the rays.
    """
    return composite(*unit_intervals(samples, alpha), rgb, background, fars)
