"""Consistency of rendered normals with rendered distances: 2D Gaussian Splatting (Huang et al. 2024), section 5."""

from __future__ import annotations

import torch
from torch import Tensor

from nerfloom.kernels.math import safe_normalize

MIN_OPACITY = 0.5
"""Minimum opacity of a pixel that counts. The mean distance of a more transparent pixel belongs to no surface."""


def normals_of_distances(distances: Tensor, directions: Tensor) -> Tensor:
    """Return the unit normals (H - 2, W - 2, 3) of a surface at the inner pixels of an image, towards the camera.

    A normal is the cross product of the differences between the points of opposite neighbours. It is 0 if these
    points coincide.

    Args:
        distances: (H, W) distance of the surface along each pixel's ray, scene units.
        directions: (H, W, 3) unit directions of the rays, in the scene's frame.
    """
    points = distances[..., None] * directions
    down, across = points[2:, 1:-1] - points[:-2, 1:-1], points[1:-1, 2:] - points[1:-1, :-2]
    return safe_normalize(torch.linalg.cross(down, across))


def normal_error(
    normals: Tensor, distances: Tensor, transmittance: Tensor, directions: Tensor, kept: Tensor | None = None
) -> Tensor:
    """Return the mean error () of rendered normals against the rendered surface's normals; 0 if no pixel counts.

    The error of a pixel is sum_i w_i (1 - n_i . N). w_i and n_i are the weights and normals of the Gaussians in it, and
    N is the normal of the surface at the mean distances. A pixel counts if it and its four neighbours are kept and at
    least half opaque.

    Args:
        normals: (H, W, 3) sums of weight times normal.
        distances: (H, W) sums of weight times distance.
        transmittance: (H, W).
        directions: (H, W, 3) unit directions of the rays, in the frame of the normals.
        kept: (H, W) bool, pixels that may count; None for all.
    """
    opacity = 1 - transmittance
    solid = opacity.detach() > MIN_OPACITY
    if kept is not None:
        solid = solid & kept
    counts = solid[1:-1, 1:-1] & solid[2:, 1:-1] & solid[:-2, 1:-1] & solid[1:-1, 2:] & solid[1:-1, :-2]
    surface = normals_of_distances(distances / opacity.clamp(min=MIN_OPACITY), directions)
    apart = opacity[1:-1, 1:-1] - (normals[1:-1, 1:-1] * surface).sum(-1)
    return torch.where(counts, apart, 0).sum() / counts.sum().clamp(min=1)
