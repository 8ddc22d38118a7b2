"""Losses: pure functions of tensors."""

from __future__ import annotations

import torch
from torch import Tensor

from framework.geometry.rays import Samples
from framework.kernels.compositing import distortion, ray_sum


def mean_squared_error(prediction: Tensor, target: Tensor, weights: Tensor | None = None) -> Tensor:
    """Return the mean () of weight * (prediction - target)^2 over all elements; 0 for empty input.

    Args:
        prediction: (R, C) predicted values.
        target: (R, C) true values.
        weights: (R,) factor of each row; None for 1.
    """
    if prediction.numel() == 0:
        return prediction.sum()
    squares = (prediction - target).square()
    return squares.mean() if weights is None else (squares * weights[:, None]).mean()


def charbonnier(prediction: Tensor, target: Tensor, weights: Tensor | None = None, scale: float = 1e-3) -> Tensor:
    """Return the mean () of weight * sqrt((prediction - target)^2 + scale^2) over all elements; 0 for empty input.

    mip-NeRF 360 (Barron et al. 2022), section 5: a smooth absolute error, to which outliers count less than squared.

    Args:
        prediction: (R, C) predicted values.
        target: (R, C) true values.
        weights: (R,) factor of each row; None for 1.
        scale: difference below which the error is square rather than absolute.
    """
    if prediction.numel() == 0:
        return prediction.sum()
    errors = ((prediction - target).square() + scale**2).sqrt()
    return errors.mean() if weights is None else (errors * weights[:, None]).mean()


def normalised_distortion(weights: Tensor, samples: Samples) -> Tensor:
    """Return the mean distortion () of rays in normalised distance: mip-NeRF 360 (Barron et al. 2022), equation 15.

    Args:
        weights: (N,) weights of the samples of R rays.
        samples: N samples, with their edges in normalised distance, as a `ProposalSampler` returns them.

    Raises:
        ValueError: if the samples have no such edges.
    """
    if samples.edges is None:
        raise ValueError("these samples have no edges in normalised distance: the sampler is no ProposalSampler")
    return distortion(weights, Samples.regular(samples.edges[:, :-1], samples.edges[:, 1:])).mean()


def depth_error(weights: Tensor, samples: Samples, known: Tensor) -> Tensor:
    """Return the relative error () of the depth of rays: the mean over rays of sum_i w_i min(|t_i - d| / d, 1).

    Unlike the error of the expected depth, it is small only if all weight is at the known depth.

    Args:
        weights: (N,) weights of the samples of R rays.
        samples: N samples.
        known: (R,) known distances d along the rays, scene units; 0 if unknown, in which case the ray is left out.
    """
    has_depth = known > 0
    if not bool(has_depth.any()):
        return weights.sum() * 0
    depths = torch.where(has_depth, known, torch.ones_like(known))[samples.ray_indices]
    # Without the bound, far samples, which are sparse where distances are in disparity, would dominate the mean.
    apart = ((samples.t - depths).abs() / depths).clamp(max=1)
    return ray_sum(weights * apart, samples)[has_depth].mean()


def mean_depth_error(distances: Tensor, transmittance: Tensor, known: Tensor) -> Tensor:
    """Return the relative error () of the mean distance of what pixels show, at most 1 each, where it is known.

    Args:
        distances: (H, W) sums of weight times distance.
        transmittance: (H, W).
        known: (H, W) true distances, 0 where unknown.
    """
    opacity = 1 - transmittance
    counts = (known > 0) & (opacity.detach() > 0.5)
    mean = distances / opacity.clamp(min=0.5)
    apart = ((mean - known).abs() / known.clamp(min=1e-6)).clamp(max=1)
    return torch.where(counts, apart, 0).sum() / counts.sum().clamp(min=1)
