"""Frequency encoding: NeRF (Mildenhall et al. 2020), equation 4."""

from __future__ import annotations

import torch
from torch import Tensor


def frequency_encoding(x: Tensor, num_frequencies: int, include_input: bool = True) -> Tensor:
    """sin and cos of x times 1, 2, 4, ..., 2^(L - 1).

    The factor pi of equation 4 is left out, as in the authors' own code. float32 resolves the highest
    frequency only while |x| * 2^(L - 1) stays well below 10^5: scenes are scaled to about 1.

    Args:
        x: (N, D) input.
        num_frequencies: L, at least 0.
        include_input: put x itself in front.
    Returns: (N, D * (2 L + include_input)): [x, sin(x), cos(x), sin(2 x), cos(2 x), ...].
    """
    scales = 2.0 ** torch.arange(num_frequencies, device=x.device, dtype=x.dtype)
    angles = x[:, None, :] * scales[:, None]
    waves = torch.stack([angles.sin(), angles.cos()], dim=2).flatten(1)
    return torch.cat([x, waves], dim=-1) if include_input else waves
