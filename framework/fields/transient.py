"""The transient part of an image: NeRF in the Wild (Martin-Brualla et al. 2021), section 4.2."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor, nn
from torch.nn import functional

from nerfloom.fields.base import MLP
from nerfloom.geometry.rays import Rays
from nerfloom.kernels.encodings.contraction import contract_to_unit
from nerfloom.kernels.encodings.frequency import frequency_encoding
from nerfloom.kernels.table_memory import require

FREQUENCIES = 6
"""Number of frequencies of positions, which are an input because a field's features need not determine the position."""


class TransientHead(nn.Module):
    """Density, colour and uncertainty that exist in one image alone: NeRF-W, equation 10.

    Each image has vectors at the vertices of a square grid over it, with interpolation between them. With one vertex,
    this is the paper's transient vector.

    Args:
        num_features: number F of features of the field.
        size: length S of a vector.
        resolution: vertices along each side of an image's map.
        width: features of a hidden layer.
        box: (2, 3) corners of the box, scene units.
        camera_to_worlds: (M, 3, 4) poses of the training cameras.
        start: density before training, 1/length.
    """

    box: Tensor
    turns: Tensor
    reach: Tensor

    def __init__(
        self,
        num_features: int,
        size: int,
        resolution: int,
        width: int,
        box: Tensor,
        camera_to_worlds: Tensor,
        start: float,
    ) -> None:
        super().__init__()
        require(4.0 * len(camera_to_worlds) * resolution**2 * size, "the transient vectors of all images")
        self.resolution = resolution
        self.vectors = nn.Parameter(torch.zeros(len(camera_to_worlds) * resolution**2, size))
        self.network = MLP(num_features + size + 3 + 6 * FREQUENCIES, width, width, 5)
        self.register_buffer("box", box.clone())
        self.register_buffer("turns", camera_to_worlds[:, :, :3].clone())
        self.register_buffer("reach", torch.ones(()))  # tangent of the widest angle between a ray and its camera's axis
        self.start = start
        self._shown: int | None = None

    def forward(self, features: Tensor, positions: Tensor, vectors: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return transient density (N,), 1/length, colour (N, 3) in [0, 1], and uncertainty (N,), all of float32.

        Args:
            features: (N, F) features of the field.
            positions: (N, 3) scene coordinates.
            vectors: (N, S) vector of each sample's image at the ray's position in it.
        """
        placed = frequency_encoding(2 * contract_to_unit(positions, self.box) - 1, FREQUENCIES)
        density, found = self.network.density(features, vectors.to(features.dtype), placed.to(features.dtype))
        return self.start * density, found[:, 1:4].float().sigmoid(), functional.softplus(found[:, 4].float())

    @contextmanager
    def shown(self, image: int) -> Iterator[None]:
        """Give rays of no training image the vectors of the training image `image`, within a `with` block."""
        self._shown, previous = image, self._shown
        try:
            yield
        finally:
            self._shown = previous

    def vectors_of(self, rays: Rays) -> Tensor | None:
        """Return the vector (R, S) of each ray's image at the ray's position; None if rays have no training image."""
        images = rays.camera_indices
        if images is None and self._shown is not None:
            images = torch.full((len(rays),), self._shown, device=rays.origins.device)
        if images is None:
            return None
        local = torch.einsum("rij,ri->rj", self.turns.to(rays.directions)[images], rays.directions.detach())
        across = local[:, :2] / (local[:, 2:].neg().clamp(min=1e-3) * self.reach)  # -1 and 1 at the edges
        place = (across.clamp(-1, 1) + 1) / 2 * (self.resolution - 1)
        low = place.floor().clamp(max=max(self.resolution - 2, 0))
        share, total = place - low, torch.zeros((), device=place.device)
        for x, y in ((0, 0), (1, 0), (0, 1), (1, 1)):
            column, row = ((low[:, k] + s).clamp(max=self.resolution - 1).long() for k, s in ((0, x), (1, y)))
            weight = (share[:, 0] if x else 1 - share[:, 0]) * (share[:, 1] if y else 1 - share[:, 1])
            vertex = (images * self.resolution + row) * self.resolution + column
            total = total + weight[:, None].to(self.vectors) * functional.embedding(vertex, self.vectors)
        return total
