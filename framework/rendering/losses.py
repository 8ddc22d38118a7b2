"""Losses: pure functions of tensors."""

from __future__ import annotations

import torch
from torch import Tensor

from framework.geometry.rays import Samples
from framework.kernels.compositing import ray_sum


def mean_squared_error(prediction: Tensor, target: Tensor, weights: Tensor | None = None) -> Tensor:
    """Mean of (prediction - target)^2 over all elements. 0 for empty input, so that an empty batch is harmless.

    Args:
        prediction, target: (R, C).
        weights: (R,) what each row's part is multiplied by; None for 1.
    """
    if prediction.numel() == 0:
        return prediction.sum()
    squares = (prediction - target).square()
    return squares.mean() if weights is None else (squares * weights[:, None]).mean()


def depth_error(weights: Tensor, samples: Samples, known: Tensor) -> Tensor:
    """How far light comes from, relative to how far it is known to: mean of sum_i w_i |t_i - d| / d.

    Unlike the error of the mean distance, it is only small where all of the light comes from there.

    Args:
        weights: (N,) of the samples of R rays.
        samples: their intervals.
        known: (R,) distances d; 0 where unknown, and the ray does not count.
    """
    there = known > 0
    if not bool(there.any()):
        return weights.sum() * 0
    wanted = torch.where(there, known, torch.ones_like(known))[samples.ray_indices]
    # Light from beyond twice the distance counts as from there: disparity's tail would drown all else.
    apart = ((samples.t - wanted).abs() / wanted).clamp(max=1)
    return ray_sum(weights * apart, samples)[there].mean()
