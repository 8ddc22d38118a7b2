"""Display colours of linear light: the transfer function of sRGB (IEC 61966-2-1)."""

from __future__ import annotations

import torch
from torch import Tensor

_KNEE = 0.0031308


def to_srgb(light: Tensor) -> Tensor:
    """Return the display colours of linear light, unclipped; its gradient is finite everywhere.

    Args:
        light: linear light of any shape, at least 0; 1 is white.
    """
    curve = 1.055 * light.clamp(min=_KNEE) ** (1 / 2.4) - 0.055
    return torch.where(light <= _KNEE, 12.92 * light, curve)
