"""Moves of Gaussians by Markov chain Monte Carlo (Kheradmand et al. 2024, "3D Gaussian Splatting as MCMC").

Transparent Gaussians are moved to opaque ones, and new ones are added there, without a change of the picture. Noise
moves nearly transparent Gaussians, which lets them explore.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from nerfloom.base import device as devices
from nerfloom.kernels.splats.project import rotation_matrices
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.strategy import Change, Strategy

DEAD = 0.005
"""Opacity at or below which a Gaussian counts as dead."""
GROWTH = 1.05
"""Growth factor of the number of Gaussians at each change, up to the maximum number."""
MAX_COPIES = 51
"""Maximum number of copies of a Gaussian in one change."""
NOISE_SHARPNESS, NOISE_FROM = 100.0, 0.005
"""Steepness of the sigmoid that reduces noise with opacity, and the opacity at its midpoint."""


class Mcmc(Strategy):
    """Dead Gaussians move to live ones, and a few are added each time."""

    changes_per_doubling = 15.0

    def grow(self, gaussians: Gaussians, most: int, extent: float) -> Change | None:
        return moved(gaussians, growth(len(gaussians), most))


def growth(count: int, most: int) -> int:
    """Return the number of Gaussians that a change adds.

    Args:
        count: number of Gaussians before it.
        most: maximum number of Gaussians afterwards.
    """
    return max(min(most, int(GROWTH * count)) - count, 0)


def moved(gaussians: Gaussians, added: int, scores: Tensor | None = None) -> Change | None:
    """Move dead Gaussians to live ones, and add more.

    Args:
        gaussians: all N Gaussians.
        added: number of Gaussians to add.
        scores: (N,) relative probability that a live Gaussian is chosen, positive; None for its opacity.

    Returns:
        The Gaussians that stay, and the new ones: all copies of each chosen Gaussian. None if nothing changes.
    """
    opacity = torch.sigmoid(gaussians.logits)
    alive = (opacity > DEAD) & gaussians.finite()
    wanted = int((~alive).sum()) + added
    if wanted == 0 or not bool(alive.any()):
        return None
    weight = torch.where(alive, opacity if scores is None else scores, 0).cumsum(0)
    draws = (torch.arange(wanted, device=weight.device) + torch.rand(wanted, device=weight.device)) / wanted
    sources = torch.searchsorted(weight, draws * weight[-1]).clamp(max=len(weight) - 1)
    copies = torch.bincount(sources, minlength=len(gaussians)).clamp(max=MAX_COPIES - 1)
    chosen = copies.nonzero()[:, 0]
    count = copies[chosen] + 1
    logits, log_scales = shared(gaussians.logits[chosen], gaussians.log_scales[chosen], count)
    index = torch.repeat_interleave(torch.arange(len(chosen), device=count.device), count)
    fresh = replace(gaussians[chosen[index]], log_scales=log_scales[index], logits=logits[index])
    return Change((alive & (copies == 0)).nonzero()[:, 0], fresh)


def shared(logits: Tensor, log_scales: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
    """Return the parameters of n equal Gaussians that together look like one.

    Equation 9 of the paper: alpha' = 1 - (1 - alpha)^(1/n), and scales times
    alpha / sum_{i=1}^{n} sum_{k=0}^{i-1} binom(i-1, k) (-1)^k alpha'^{k+1} / sqrt(k+1).

    Args:
        logits: (K,) opacity before the sigmoid.
        log_scales: (K, 3).
        counts: (K,) int64 n, number of copies, at most MAX_COPIES.

    Returns:
        (K,) logits and (K, 3) logarithms of scales of each copy.
    """
    # In float64: the sum alternates, and its terms are up to ten thousand times larger than the result.
    alpha = torch.sigmoid(devices.to_float64(logits)).clamp(1e-6, 1 - 1e-6)
    n = counts.to(alpha)[:, None]
    each = -torch.expm1(torch.log1p(-alpha) / n[:, 0])
    most = int(counts.max()) if len(counts) else 1
    # sum_{i=1}^{n} binom(i-1, k) = binom(n, k+1)
    k = torch.arange(most, device=alpha.device, dtype=alpha.dtype)
    log_binomial = torch.lgamma(n + 1) - torch.lgamma(k + 2) - torch.lgamma((n - k).clamp(min=1))
    terms = torch.exp(log_binomial + (k + 1) * each.log()[:, None]) / (k + 1).sqrt() * (1 - 2 * (k % 2))
    total = terms.masked_fill(k[None] >= n, 0).sum(1)
    factor = alpha / total.clamp(min=1e-12)
    return torch.logit(each.clamp(DEAD, 1 - 1e-6)).to(logits), log_scales + factor.log().to(log_scales)[:, None]


@torch.no_grad()
def faint(logits: Tensor) -> Tensor | None:
    """Return the indices (K,) of nearly transparent Gaussians, which `noise` is for; None for all.

    On a device that runs ahead of Python, all Gaussians get noise, to avoid a synchronisation; it is negligible for
    opaque ones.

    Args:
        logits: (N,) opacities before the sigmoid.
    """
    if devices.runs_ahead(logits.device):
        return None
    return (torch.sigmoid(logits) < NOISE_FROM + 6 / NOISE_SHARPNESS).nonzero()[:, 0]


@torch.no_grad()
def noise(gaussians: Gaussians, size: float | Tensor) -> Tensor:
    """Return shifts (K, 3) of the centres of nearly transparent Gaussians, scene units (the paper's equation 7).

    Args:
        gaussians: K Gaussians.
        size: the noise of a transparent Gaussian, in its standard deviations squared per scene unit; possibly () on the
            device.
    """
    gate = torch.sigmoid(-NOISE_SHARPNESS * (torch.sigmoid(gaussians.logits) - NOISE_FROM))
    axes = rotation_matrices(gaussians.rotations) * gaussians.log_scales.exp()[:, None]
    shifts = torch.randn(len(gate), 3, device=gate.device) * (size * gate)[:, None]
    return (axes @ (axes.transpose(1, 2) @ shifts[:, :, None]))[:, :, 0]
