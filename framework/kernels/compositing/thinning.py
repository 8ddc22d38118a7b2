"""Thinning of gradients: a random fraction of samples with small gradients is kept, scaled up to preserve the mean.

After the first steps most samples along rays have gradients much smaller than the mean: samples in empty space, behind
surfaces, and of pixels that are already right. Networks and tables skip samples with zero gradient (`mlp`, `hash_grid`,
`planes`), so a step takes less time. The roulette is from Arvo and Kirk 1990, "Particle Transport and Image
Synthesis".
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


class _Thinned(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, sigma: Tensor, rgb: Tensor, floor: float) -> tuple[Tensor, Tensor]:
        ctx.floor = floor
        ctx.save_for_backward(sigma, torch.rand_like(sigma))
        ctx.set_materialize_grads(False)
        return sigma.view_as(sigma), rgb.view_as(rgb)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, of_sigma: Tensor | None, of_rgb: Tensor | None) -> tuple[Tensor | None, ...]:
        sigma, draws = ctx.saved_tensors
        size = torch.zeros_like(sigma) if of_sigma is None else (of_sigma * sigma).abs()
        if of_rgb is not None:
            red, green, blue = of_rgb.abs().unbind(-1)  # torch's norm along an axis of 3 takes fifty times as long
            size = size + (red + green + blue)
        chance = (size / (ctx.floor * size.mean())).clamp(max=1)
        # NaN, of a gradient or where all are 0, is never below a chance; times 0 it stays NaN, so that it is noticed.
        factor = torch.where(draws < chance, 1 / chance, torch.zeros_like(chance))
        sigma_grad = None if of_sigma is None else of_sigma * factor
        return sigma_grad, None if of_rgb is None else of_rgb * factor[:, None], None


def thinned(sigma: Tensor, rgb: Tensor, floor: float) -> tuple[Tensor, Tensor]:
    """Return density (or opacity) and colour of samples unchanged, with most small gradients set to zero.

    The size of a sample's gradient is the size for its log-density plus the sum over colour channels. A sample below
    the bound is kept with a probability proportional to its size, and its gradients are divided by that probability, so
    the expected gradients are unchanged. If a density is 0, its own gradient counts as 0, because the density cannot
    decrease.

    Args:
        sigma: (N,) density in 1/length.
        rgb: (N, 3) colour.
        floor: the bound, relative to the mean size of all N; more than 0.
    """
    found: tuple[Tensor, Tensor] = _Thinned.apply(sigma, rgb, floor)
    return found
