"""Fittest: Gaussians with the largest image gradients are copied, and the faintest are dropped."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from nerfloom.kernels.splats.project import SplatCamera
from nerfloom.methods import gaussian_splatting
from nerfloom.methods.gaussian_splatting import GaussianSplatting
from nerfloom.splats.density_control import GradientMean
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.strategy import Change, Rows, Strategy

DROPPED, COPIED = 20, 5
"""One Gaussian in this many is removed at a change, and one in this many is added."""


class Fittest(Strategy):
    """Selection by opacity, growth by gradients."""

    def __init__(self) -> None:
        super().__init__()
        self.gradients = GradientMean()

    def watch(self, records: Tensor, camera: SplatCamera, rows: Rows | None = None) -> None:
        self.gradients.watch(records, camera, rows)

    def after_every_step(self, finite: bool | Tensor) -> None:
        self.gradients.add(finite)

    def grow(self, gaussians: Gaussians, most: int, extent: float) -> Change | None:
        count = len(gaussians)
        kept = gaussians.logits.argsort(descending=True)[: count - count // DROPPED].sort().values
        added = max(min(most - len(kept), count // COPIED), 0)
        chosen = kept[self.gradients.take(count)[kept].topk(added).indices]
        return Change(kept, gaussians[chosen])


class FittestSplatting(GaussianSplatting):
    """3D Gaussian Splatting with another strategy."""

    def make_strategy(self) -> Strategy:
        return Fittest()


METHOD = replace(gaussian_splatting.METHOD, model=FittestSplatting, paper="none")
