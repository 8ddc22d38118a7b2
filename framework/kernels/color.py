"""Display colours and linear light: the transfer function of sRGB (IEC 61966-2-1)."""

from __future__ import annotations

import torch
from torch import Tensor

_KNEE = 0.0031308
_DISPLAY_KNEE = 0.04045


def to_srgb(light: Tensor) -> Tensor:
    """Return the display colours of linear light, unclipped; its gradient is finite everywhere.

    Args:
        light: linear light of any shape, at least 0; 1 is white.
    """
    curve = 1.055 * light.clamp(min=_KNEE) ** (1 / 2.4) - 0.055
    return torch.where(light <= _KNEE, 12.92 * light, curve)


def to_linear(display: Tensor) -> Tensor:
    """Return the linear light of display colours, the inverse of `to_srgb`.

    Args:
        display: colours of any shape, at least 0; 1 is white.
    """
    curve = ((display.clamp(min=_DISPLAY_KNEE) + 0.055) / 1.055) ** 2.4
    return torch.where(display <= _DISPLAY_KNEE, display / 12.92, curve)
