"""Instant-NGP through fog: colours fade to grey with distance."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from nerfloom import Field, Rays, Rendered, Samples, VolumeRenderer
from nerfloom.methods import instant_ngp

GREY, DENSITY = 0.5, 0.2
"""Colour of the fog in all channels, and how much of it there is, 1/length."""


class FogRenderer(VolumeRenderer):
    """Volume rendering, weighted with fog by the expected depth."""

    def render(self, rays: Rays, samples: Samples, field: Field, background: Tensor) -> Rendered:
        clear = super().render(rays, samples, field, background)
        left = torch.exp(-DENSITY * clear.depth)[:, None]
        return replace(clear, rgb=left * clear.rgb + (1 - left) * GREY)


METHOD = replace(instant_ngp.METHOD, renderer=lambda config, scene: FogRenderer())
