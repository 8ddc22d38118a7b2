"""Periodic relocation: transparent Gaussians are moved to where gradients and opacities are large.

Source: Wang et al., "FreeTimeGS: Free Gaussian Primitives at Anytime Anywhere for Dynamic Scene Reconstruction", CVPR
2025, arXiv:2506.05348. The sampling score of a Gaussian is lambda_g g + lambda_o sigma, with its gradient g and its
opacity sigma. Here each is divided by its mean, so that their units do not matter. Copies share opacity and size as in
3DGS-MCMC (Kheradmand et al. 2024), so that the picture does not change.
"""

from __future__ import annotations

import torch
from torch import Tensor

from nerfloom.kernels.splats.project import SplatCamera
from nerfloom.splats.density_control import GradientMean
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.mcmc import Mcmc, growth, moved
from nerfloom.splats.strategy import Change, Rows, Strategy

GRADIENT_WEIGHT, OPACITY_WEIGHT = 0.5, 0.5
"""Weights lambda_g and lambda_o of the sampling score."""


class Relocation(Strategy):
    """Dead Gaussians move to Gaussians with a large sampling score, and a few are added each time."""

    changes_per_doubling = Mcmc.changes_per_doubling

    def __init__(self) -> None:
        super().__init__()
        self.gradients = GradientMean()

    def watch(self, records: Tensor, camera: SplatCamera, rows: Rows | None = None) -> None:
        self.gradients.watch(records, camera, rows)

    def after_every_step(self, finite: bool | Tensor) -> None:
        self.gradients.add(finite)

    def grow(self, gaussians: Gaussians, most: int, extent: float) -> Change | None:
        count = len(gaussians)
        scores = sampling_scores(self.gradients.take(count), torch.sigmoid(gaussians.logits))
        return moved(gaussians, growth(count, most), scores)


def sampling_scores(gradients: Tensor, opacities: Tensor) -> Tensor:
    """Return the sampling scores (N,) of Gaussians; their mean is 1 if there are gradients, else 0.5.

    Args:
        gradients: (N,) mean gradient of the image positions, as `image_gradients` returns them.
        opacities: (N,) in [0, 1].
    """
    return GRADIENT_WEIGHT * _relative(gradients) + OPACITY_WEIGHT * _relative(opacities)


def _relative(values: Tensor) -> Tensor:
    """Return values (N,) divided by their mean without NaNs; zeros stay zeros."""
    return values / values.nanmean().clamp(min=1e-20)
