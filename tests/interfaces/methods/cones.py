"""Cones: a network asked for the mean of its encoding over conical frustums, as in Mip-NeRF (Barron et al. 2021)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor
from torch.nn.functional import softplus

from nerfloom import Field, Method, Points, RayConfig, Sampler, Scene
from nerfloom.fields.base import MLP
from nerfloom.geometry.points import Footprint
from nerfloom.kernels.encodings.spherical_harmonics import spherical_harmonics
from nerfloom.samplers.uniform import UniformSampler


@dataclass(frozen=True)
class ConeConfig(RayConfig, max_num_iterations=2_000, num_rays_per_batch=256, learning_rate=5e-3):
    """Settings of cones."""

    num_frequencies: int = 6
    """L of the integrated encoding."""
    num_samples: int = 32
    """Intervals on a ray."""


class ConeField(Field):
    """Density and colour of a Gaussian in space.

    Args:
        num_frequencies: L of the encoding.
    """

    footprint: ClassVar[Footprint] = "gaussian"

    def __init__(self, num_frequencies: int) -> None:
        super().__init__()
        self.num_frequencies = num_frequencies
        self.trunk = MLP(6 * num_frequencies, 64, 64, 17)
        self.head = MLP(16 + 16, 64, 3, activation="sigmoid")

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        values = self.trunk(integrated_encoding(points, self.num_frequencies))
        return softplus(values[:, 0].float() - 1), values[:, 1:]

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        return self.head(features, spherical_harmonics(directions).to(features.dtype)).float()


def integrated_encoding(points: Points, num_frequencies: int) -> Tensor:
    """Return the expected sines and cosines of Gaussians: Mip-NeRF, equation 14.

    Args:
        points: N points with covariances.
        num_frequencies: L.
    Raises: ValueError for points without a size.
    """
    if points.covariances is None:
        raise ValueError("cones are asked at points with covariances")
    scales = 2.0 ** torch.arange(num_frequencies, device=points.positions.device)
    angles = points.positions[:, None] * scales[:, None]
    damping = torch.exp(-0.5 * points.covariances[:, None] * scales[:, None] ** 2)
    return torch.cat([damping * angles.sin(), damping * angles.cos()], -1).flatten(1)


def make_sampler(config: ConeConfig, scene: Scene) -> Sampler:
    """Return even intervals between near and far."""
    return UniformSampler(config.num_samples)


METHOD = Method(
    ConeConfig(), paper="none", field=lambda config, scene: ConeField(config.num_frequencies), sampler=make_sampler
)
