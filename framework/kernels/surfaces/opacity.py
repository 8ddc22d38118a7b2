"""Opacity of intervals along rays near surfaces, and density, from signed distances.

NeuS: Wang et al. 2021, "Learning Neural Implicit Surfaces by Volume Rendering for Multi-view Reconstruction". VolSDF:
Yariv et al. 2021, "Volume Rendering of Neural Implicit Surfaces".
"""

from __future__ import annotations

import torch
from torch import Tensor


def surface_opacity(
    distances: Tensor, cosines: Tensor, lengths: Tensor, sharpness: Tensor, annealing: float = 1.0
) -> Tensor:
    """Return the opacity of intervals: NeuS, equation 13.

    The distance is linear within an interval: f(t) = f + cosine t. With the logistic function S of `sharpness` times
    the distance, the opacity is (S(start) - S(end)) / S(start), and 0 where a ray leaves a surface.

    Args:
        distances: (N,) signed distance f in the middle of each interval, negative inside.
        cosines: (N,) derivative of f along the ray.
        lengths: (N,) lengths of the intervals, in the unit of the distance.
        sharpness: () inverse width of the transition from transparent to opaque at a surface.
        annealing: 1 for the paper's formula. Below 1, intervals with a distance that does not fall are partly opaque
            too, so that wrong surfaces that face away also have a gradient; 0 at the start of training.

    Returns:
        (N,) opacity in [0, 1].
    """
    falling = torch.relu(-cosines)
    if annealing < 1:
        falling = falling * annealing + torch.relu(0.5 - 0.5 * cosines) * (1 - annealing)
    half = falling * lengths / 2
    # 1 - S(a) / S(b) = S(-a) (1 - exp(a - b)) has no cancellation.
    return torch.sigmoid(sharpness * (half - distances)) * -torch.expm1(-2 * sharpness * half)


def laplace_density(distances: Tensor, beta: Tensor) -> Tensor:
    """Return the density at signed distances: VolSDF, equations 2 and 3, with alpha = 1 / beta.

    Args:
        distances: (N,) signed distances, negative inside.
        beta: () scale of the Laplace distribution, in the unit of the distance.

    Returns:
        (N,) density, 1/length: 1 / beta deep inside, half of it on the surface.
    """
    outside = 0.5 * torch.exp(-distances.abs() / beta)
    return torch.where(distances > 0, outside, 1 - outside) / beta
