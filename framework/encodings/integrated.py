"""Integrated encoding of a box or of all of space: Mip-NeRF (Barron et al. 2021), mip-NeRF 360 (Barron et al. 2022)."""

from __future__ import annotations

from itertools import combinations

import torch
from torch import Tensor, nn
from torch.nn.functional import normalize

from nerfloom.data.scene import Scene
from nerfloom.geometry.bounds import contract_gaussians, half_edge
from nerfloom.geometry.points import Points


class IntegratedEncoding(nn.Module):
    """Expected sines and cosines of the Gaussians of points, in units of a box.

    The box is centred at the origin, and its faces are at -1 and 1. Waves along the three axes alone cannot tell a
    Gaussian that is long in a diagonal direction from a ball; further directions can (mip-NeRF 360, section 2).

    Args:
        box: (2, 3) corners of the box, scene units.
        num_frequencies: number L of frequencies.
        deviation: standard deviation assumed for points without a size, scene units.
        contracted: whether all of space is contracted into the ball of radius 2 around the box.
        directions: (K, 3) unit directions of the waves; the three axes if None.
    """

    box: Tensor
    directions: Tensor | None

    def __init__(
        self,
        box: Tensor,
        num_frequencies: int,
        deviation: float,
        contracted: bool = False,
        directions: Tensor | None = None,
    ) -> None:
        super().__init__()
        self.register_buffer("box", box.clone())
        self.register_buffer("directions", directions, persistent=False)
        self.num_frequencies, self.deviation, self.contracted = num_frequencies, deviation, contracted
        self.num_features = 2 * num_frequencies * (3 if directions is None else len(directions))

    @classmethod
    def of_images(
        cls, scene: Scene, num_frequencies: int, contracted: bool, directions: Tensor | None = None
    ) -> IntegratedEncoding:
        """Return the encoding of a scene, where points without a size deviate by half a pixel or so.

        `num_frequencies`, `contracted` and `directions` are as in the constructor.
        """
        return cls(scene.box, num_frequencies, half_edge(scene.box) / scene.image_size, contracted, directions)

    def forward(self, points: Points) -> Tensor:
        """Return the encoding (N, 2 K L) of `points`."""
        points = points.sized(self.deviation)
        middle, half = (self.box[0] + self.box[1]) / 2, (self.box[1] - self.box[0]) / 2
        means = (points.positions - middle) / half
        if self.directions is None and not self.contracted:
            assert points.covariances is not None
            return integrated_encoding(means, points.covariances / half.square(), self.num_frequencies)
        roots = points.roots() / half[:, None]
        if self.contracted:
            means, roots = contract_gaussians(means, roots)
        if self.directions is None:
            return integrated_encoding(means, roots.square().sum(-1), self.num_frequencies)
        # Products and sums, because autocast would round a matrix product to bfloat16.
        along = (means[:, None] * self.directions).sum(-1)
        spreads = [(roots[:, None, :, column] * self.directions).sum(-1).square() for column in range(3)]
        return integrated_encoding(along, torch.stack(spreads).sum(0), self.num_frequencies)


def integrated_encoding(means: Tensor, variances: Tensor, num_frequencies: int) -> Tensor:
    """Return the expected sines and cosines of Gaussians times 1, 2, 4, ..., 2^(L - 1): equation 14.

    A frequency with waves much shorter than a Gaussian averages to 0, so that a network sees no detail smaller than the
    region it is evaluated for.

    Args:
        means: (N, K) mean along each of K directions, of any float type.
        variances: (N, K) variance along each direction, at least 0.
        num_frequencies: number L of frequencies.

    Returns:
        (N, 2 K L) values sin(x), cos(x), sin(2 x), cos(2 x), ... of all directions, each times exp(-4^l variance / 2),
        in the order of `frequency_encoding` without its input; float64 if `means` is float64, and float32 otherwise.
    """
    kind = torch.float64 if means.dtype == torch.float64 else torch.float32
    means, variances = means.to(kind), variances.to(kind)
    scales = 2.0 ** torch.arange(num_frequencies, device=means.device, dtype=kind)[:, None]
    angles = means[:, None] * scales
    kept = torch.exp(-0.5 * variances[:, None] * scales.square())
    return torch.stack([kept * angles.sin(), kept * angles.cos()], dim=-2).flatten(1)


def icosahedron_directions() -> Tensor:
    """Return the directions (21, 3) of mip-NeRF 360: corners and edge middles of an icosahedron, one of each pair.

    The icosahedron's faces are each divided into four; of two opposite directions one is kept. Appendix A of the paper.
    """
    golden = (1 + 5**0.5) / 2
    pairs = [(1.0, golden), (1.0, -golden), (-1.0, golden), (-1.0, -golden)]
    corners = torch.tensor([corner for a, b in pairs for corner in ((0.0, a, b), (a, b, 0.0), (b, 0.0, a))])
    edges = [(a, b) for a, b in combinations(corners.double(), 2) if (a - b).norm() < 2.1]  # the shortest are 2 long
    middles = torch.stack([(a + b) / 2 for a, b in edges])
    every = normalize(torch.cat([corners.double(), middles]), dim=-1)
    return torch.stack([each for each in every if _is_first(each)]).float()


def _is_first(direction: Tensor) -> bool:
    """Return whether the first coordinate that is not 0 is positive; this holds for one of two opposite directions."""
    return next(value > 0 for value in direction.tolist() if abs(value) > 1e-6)
