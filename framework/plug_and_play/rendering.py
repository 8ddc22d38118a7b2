"""Compositing of user-defined colours and densities, or alphas, over a background."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from nerfloom.geometry.rays import Rays, Samples
from nerfloom.kernels.compositing.alpha import unit_intervals
from nerfloom.kernels.compositing.density import ray_sum
from nerfloom.kernels.math import at_least_float32
from nerfloom.plug_and_play.functions import RgbFunction, check_rays, evaluate
from nerfloom.rendering.volume import volume_render


@dataclass(frozen=True)
class Rendering:
    """Rendered values of R rays with N samples."""

    rgb: Tensor
    """(R, 3) colour over the background."""
    depth: Tensor
    """(R,) expected distance, the weighted mean of t; the far end of the ray if it is transparent."""
    median_depth: Tensor
    """(R,) distance where the transmittance falls to 0.5; the far end of the ray if it does not."""
    accumulation: Tensor
    """(R,) opacity, the sum of the weights."""
    weights: Tensor
    """(N,) weight of each sample."""
    extras: dict[str, Tensor]
    """(R, ...) weighted sum of each further property by name, without a background."""


def render(
    rays: Rays,
    samples: Samples,
    rgb_sigma_fn: RgbFunction | None = None,
    background: Tensor | Sequence[float] | float = 0.0,
    *,
    rgb_alpha_fn: RgbFunction | None = None,
) -> Rendering:
    """Evaluate a field at samples and composite its values: NeRF (Mildenhall et al. 2020), equation 3.

    Gradients flow to the parameters of the function, and to the rays through positions and directions, with t held
    fixed.

    Args:
        rays: R rays.
        samples: N samples along the rays; N may be 0.
        rgb_sigma_fn: function (positions (N, 3), directions (N, 3)) -> rgb (N, 3), sigma (N,); if the rays have times,
            it is called as (positions, directions, times (N,)). It may return a third value, a dictionary of further
            properties (N, ...) by name (specularity, features, semantics), which are summed with the same weights.
        background: (3,), (R, 3) or one number: colour of the background.
        rgb_alpha_fn: alternative to `rgb_sigma_fn` that returns the opacity alpha (N,) in [0, 1] of each sample instead
            of sigma (NeuS, Wang et al. 2021).

    Raises:
        ValueError: if neither or both functions are given, if the samples belong to another number of rays, or if the
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
    """Return the weighted sum of a property of samples along each ray.

    Args:
        samples: N samples of R rays.
        weights: (N,) weights, such as `Rendering.weights`; detach them to train the property only.
        values: (N, ...) values of the property.

    Returns:
        (R, ...) sums; 0 for a ray without samples.
    """
    values = at_least_float32(values)
    return ray_sum(weights.view(-1, *[1] * (values.ndim - 1)) * values, samples)
