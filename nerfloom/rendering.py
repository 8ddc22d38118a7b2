"""Composites a user's colours and densities, or alphas, over a background."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from framework.geometry.rays import Rays, Samples
from framework.kernels.alpha import unit_intervals
from framework.kernels.compositing import ray_sum
from framework.rendering.volume import volume_render
from nerfloom.functions import RgbFunction, at_least_float32, check_rays, evaluate


@dataclass(frozen=True)
class Rendering:
    """Holds what N samples along R rays add up to."""

    rgb: Tensor
    """(R, 3) colour over the background."""
    depth: Tensor
    """(R,) expected distance: the mean of t under the weights; the ray's far end where it met nothing."""
    median_depth: Tensor
    """(R,) distance at which half of the light is gone; the ray's far end where it never is."""
    accumulation: Tensor
    """(R,) opacity, the sum of the weights."""
    weights: Tensor
    """(N,) of the samples."""
    extras: dict[str, Tensor]
    """(R, ...) the further properties by name: sums under the weights, with nothing behind them."""


def render(
    rays: Rays,
    samples: Samples,
    rgb_sigma_fn: RgbFunction | None = None,
    background: Tensor | Sequence[float] | float = 0.0,
    *,
    rgb_alpha_fn: RgbFunction | None = None,
) -> Rendering:
    """Evaluate a field at samples and composite what it returns (NeRF, Mildenhall et al. 2020, equation 3).

    Gradients reach whatever the function is made of, and the rays through positions and directions, t held fixed.

    Args:
        rays: R rays.
        samples: N samples on them.
        rgb_sigma_fn: (positions (N, 3), directions (N, 3)) -> rgb (N, 3), sigma (N,), and where rays have times
            (positions, directions, times (N,)). A third result, a dictionary from names to tensors (N, ...), holds
            further properties (specularity, features, semantics), which are summed under the same weights. N may be 0.
        background: (3,), (R, 3) or one number, what shows where a ray is not opaque.
        rgb_alpha_fn: the same with alpha (N,) in [0, 1], the share of light that a sample stops, in place of sigma
            (NeuS, Wang et al. 2021): an alternative to `rgb_sigma_fn`.
    Raises: ValueError where neither or both functions are given, where the samples are of other rays, or where the
        function returns other shapes.
    """
    check_rays(rays)
    if samples.num_rays != len(rays):
        raise ValueError(f"the samples are of {samples.num_rays} rays, but there are {len(rays)}")
    if rgb_alpha_fn is None and rgb_sigma_fn is not None:
        rgb, sigma, properties = evaluate(rgb_sigma_fn, "sigma", rays, samples)
        intervals = samples
    elif rgb_alpha_fn is not None and rgb_sigma_fn is None:
        rgb, alpha, properties = evaluate(rgb_alpha_fn, "alpha", rays, samples)
        intervals, sigma = unit_intervals(samples, alpha)
    else:
        raise ValueError("render needs either rgb_sigma_fn or rgb_alpha_fn")
    summed = volume_render(rays, intervals, sigma, rgb, torch.as_tensor(background, device=rgb.device))
    assert summed.weights is not None
    extras = {name: accumulate(samples, summed.weights, values) for name, values in properties.items()}
    return Rendering(summed.rgb, summed.depth, summed.median_depth, summed.accumulation, summed.weights, extras)


def accumulate(samples: Samples, weights: Tensor, values: Tensor) -> Tensor:
    """Sum a property of samples along each ray under their weights.

    Args:
        samples: N samples of R rays.
        weights: (N,), such as `Rendering.weights`; detached, the sum teaches the property alone.
        values: (N, ...).
    Returns: (R, ...); 0 for a ray without samples.
    """
    values = at_least_float32(values)
    return ray_sum(weights.view(-1, *[1] * (values.ndim - 1)) * values, samples)
