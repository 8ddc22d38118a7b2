"""Integrated positional encoding: Mip-NeRF (Barron et al. 2021), section 3.1."""

from __future__ import annotations

import torch
from torch import Tensor


def integrated_encoding(means: Tensor, variances: Tensor, num_frequencies: int) -> Tensor:
    """Return the expected sines and cosines of Gaussians times 1, 2, 4, ..., 2^(L - 1): equation 14.

    A frequency with waves much shorter than a Gaussian averages to 0, so that a network sees no detail smaller than the
    region it is evaluated for.

    Args:
        means: (N, K) mean along each of K directions, of any float type.
        variances: (N, K) variance along each direction, at least 0.
        num_frequencies: number L of frequencies.

    Returns:
        (N, 2 K L) values sin(x), cos(x), sin(2 x), cos(2 x), ... of all directions, each times exp(-4^l variance / 2),
        in the order of `frequency_encoding` without its input; float64 if `means` is float64, and float32 otherwise.
    """
    kind = torch.float64 if means.dtype == torch.float64 else torch.float32
    means, variances = means.to(kind), variances.to(kind)
    scales = 2.0 ** torch.arange(num_frequencies, device=means.device, dtype=kind)[:, None]
    angles = means[:, None] * scales
    kept = torch.exp(-0.5 * variances[:, None] * scales.square())
    return torch.stack([kept * angles.sin(), kept * angles.cos()], dim=-2).flatten(1)
