"""Normals: what the density says of surfaces, and a head that learns to say it smoothly."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor, nn

from framework.fields.base import MLP, Field
from framework.geometry.points import Points
from framework.geometry.rays import Samples
from framework.kernels.compositing import ray_sum
from framework.kernels.frequency import frequency_encoding
from framework.kernels.math import safe_normalize

FREQUENCIES = 2


def density_normals(field: Field, points: Points) -> Tensor:
    """Return unit directions (N, 3) in which density falls fastest; 0 where it does not change. Without a gradient.

    One more evaluation of the field, whose parameters get no gradient from it.

    Args:
        field: whose density is looked at.
        points: N points.
    """
    parameters = [p for p in field.parameters() if p.requires_grad]
    try:
        for parameter in parameters:  # else the kernels would also take the parameters' gradients
            parameter.requires_grad_(False)
        with torch.enable_grad():
            followed = points.positions.detach().requires_grad_()
            sigma, _ = field.density(replace(points, positions=followed))
            (gradient,) = torch.autograd.grad(sigma.sum(), followed)
    finally:
        for parameter in parameters:
            parameter.requires_grad_(True)
    return -safe_normalize(gradient.float())


class NormalHead(nn.Module):
    """Normals from a field's features and the place: Ref-NeRF (Verbin et al. 2022), section 4.

    Args:
        num_features: of the field.
        width: features of the hidden layers.
    """

    def __init__(self, num_features: int, width: int = 64) -> None:
        super().__init__()
        self.network = MLP(num_features + 3 + 6 * FREQUENCIES, width, width, 3)

    def forward(self, features: Tensor, positions: Tensor) -> Tensor:
        """Unit normals (N, 3); `positions` (N, 3) are contracted ones or those of a box, of magnitude 1."""
        encoded = frequency_encoding(positions, FREQUENCIES)
        return safe_normalize(self.network(features, encoded.to(features.dtype)).float())


def normal_penalties(
    predicted: Tensor, normals: Tensor, directions: Tensor, weights: Tensor, samples: Samples
) -> dict[str, Tensor]:
    """What is wrong with predicted normals, per ray: Ref-NeRF, equations 10 and 11.

    Unlike there the density learns nothing from it: the kernels have first derivatives only.

    Args:
        predicted, normals: (N, 3) of the head and of the density.
        directions: (N, 3) of the samples' rays.
        weights: (N,) of the samples.
    Returns: "normals" (R,), how far the two are apart; "orientation" (R,), how much predicted ones face away.
    """
    weights = weights.detach()
    known = normals.square().sum(-1)  # 0 where the density does not change
    apart = weights * known * (1 - (predicted * normals).sum(-1))
    away = weights * (predicted * directions).sum(-1).clamp(min=0).square()
    return {"normals": ray_sum(apart, samples), "orientation": ray_sum(away, samples)}
