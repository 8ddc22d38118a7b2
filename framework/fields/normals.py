"""Surface normals from the gradient of the density, and from a network that predicts smoother normals."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor, nn

from nerfloom.fields.base import MLP, Field
from nerfloom.geometry.points import Points
from nerfloom.geometry.rays import Samples
from nerfloom.kernels.compositing.density import ray_sum
from nerfloom.kernels.encodings.frequency import frequency_encoding
from nerfloom.kernels.math import safe_normalize

FREQUENCIES = 2
"""Number of frequencies of the positions' encoding."""


def density_normals(field: Field, points: Points) -> Tensor:
    """Return the unit directions (N, 3) of steepest descent of the density; 0 where its gradient is 0.

    The field is evaluated once more, at N points. The result has no gradient.
    """
    parameters = [p for p in field.parameters() if p.requires_grad]
    try:
        for parameter in parameters:  # otherwise the kernels would also compute the parameters' gradients
            parameter.requires_grad_(False)
        with torch.enable_grad():
            positions = points.positions.detach().requires_grad_()
            sigma, _ = field.density(replace(points, positions=positions))
            (gradient,) = torch.autograd.grad(sigma.sum(), positions)
    finally:
        for parameter in parameters:
            parameter.requires_grad_(True)
    return -safe_normalize(gradient.float())


class NormalHead(nn.Module):
    """A network that predicts normals from a field's features and positions: Ref-NeRF (Verbin et al. 2022), section 4.

    Args:
        num_features: number F of features of the field.
        width: features of a hidden layer.
    """

    def __init__(self, num_features: int, width: int = 64) -> None:
        super().__init__()
        self.network = MLP(num_features + 3 + 6 * FREQUENCIES, width, width, 3)

    def forward(self, features: Tensor, positions: Tensor) -> Tensor:
        """Return the unit normals (N, 3).

        Args:
            features: (N, F) features of the field.
            positions: (N, 3) positions, contracted or in units of the box, so that they are of magnitude 1.
        """
        encoded = frequency_encoding(positions, FREQUENCIES)
        return safe_normalize(self.network(features, encoded.to(features.dtype)).float())


def normal_difference(predicted: Tensor, normals: Tensor) -> Tensor:
    """Return the difference (N,) of predicted normals from the density's normals: Ref-NeRF, equation 10.

    Args:
        predicted: (N, 3) predicted unit normals.
        normals: (N, 3) unit normals of the density; 0 where it is constant, where nothing is compared.
    """
    return normals.square().sum(-1) * (1 - (predicted * normals).sum(-1))


def facing_away(predicted: Tensor, directions: Tensor) -> Tensor:
    """Return the squared cosine (N,) of normals that face away from the camera, else 0: Ref-NeRF, equation 11.

    Args:
        predicted: (N, 3) predicted unit normals.
        directions: (N, 3) unit directions of the samples' rays.
    """
    return (predicted * directions).sum(-1).clamp(min=0).square()


def normal_penalties(
    predicted: Tensor, normals: Tensor, directions: Tensor, weights: Tensor, samples: Samples
) -> dict[str, Tensor]:
    """Return the penalties of predicted normals per ray: Ref-NeRF, equations 10 and 11.

    Args:
        predicted: (N, 3) predicted unit normals.
        normals: (N, 3) unit normals of the density, or 0.
        directions: (N, 3) unit directions of the samples' rays.
        weights: (N,) weights of the samples; without a gradient.
        samples: N samples of R rays.

    Returns:
        "normals_penalty" (R,), the weighted difference from the normals of the density, and "orientation_penalty" (R,),
        the weighted squared cosine of predicted normals that face away from the camera.
    """
    weights = weights.detach()
    apart, away = weights * normal_difference(predicted, normals), weights * facing_away(predicted, directions)
    return {"normals_penalty": ray_sum(apart, samples), "orientation_penalty": ray_sum(away, samples)}
