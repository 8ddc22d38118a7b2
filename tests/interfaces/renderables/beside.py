"""Beside: two runs of one scene in one picture, the left half of one and the right half of the other."""

from __future__ import annotations

import torch
from torch import Tensor

from nerfloom import Picture, Renderable, View


class Beside(Renderable):
    """Two renderables side by side.

    Args:
        left: the one on the left; its frame is taken.
        right: the one on the right, in the same frame.
    """

    def __init__(self, left: Renderable, right: Renderable) -> None:
        self.left, self.right, self.scene = left, right, left.scene

    @property
    def device(self) -> torch.device:
        return self.left.device

    @property
    def rays_per_pixel(self) -> int:
        return self.left.rays_per_pixel

    def render_view(self, view: View, background: Tensor) -> Picture:
        one, other = (half.render_view(view, background) for half in (self.left, self.right))
        middle = one.size[1] // 2

        def joined(name: str) -> Tensor:
            return torch.cat([getattr(one, name)[:, :middle], getattr(other, name)[:, middle:]], dim=1)

        values = map(joined, ("rgb", "depth", "median_depth", "accumulation"))
        return Picture(*values, num_rays=one.num_rays)
