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

    Args:
        num_features: number F of features of the field.
        num_images: number of training images.
        size: length S of an image's vector.
        width: features of a hidden layer.
        box: (2, 3) corners of the box, scene units.
        start: density before training, 1/length.
    """

    box: Tensor

    def __init__(self, num_features: int, num_images: int, size: int, width: int, box: Tensor, start: float) -> None:
        super().__init__()
        require(4.0 * num_images * size, "the transient vectors of all images")
        self.vectors = nn.Parameter(torch.zeros(num_images, size))
        self.network = MLP(num_features + size + 3 + 6 * FREQUENCIES, width, width, 5)
        self.register_buffer("box", box.clone())
        self.start = start
        self._shown: int | None = None

    def forward(self, features: Tensor, positions: Tensor, vectors: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return transient density (N,), 1/length, colour (N, 3) in [0, 1], and uncertainty (N,), all of float32.

        Args:
            features: (N, F) features of the field.
            positions: (N, 3) scene coordinates.
            vectors: (N, S) vector of each sample's image.
        """
        placed = frequency_encoding(2 * contract_to_unit(positions, self.box) - 1, FREQUENCIES)
        density, found = self.network.density(features, vectors.to(features.dtype), placed.to(features.dtype))
        return self.start * density, found[:, 1:4].float().sigmoid(), functional.softplus(found[:, 4].float())

    @contextmanager
    def shown(self, image: int) -> Iterator[None]:
        """Give rays of no training image the vector of the training image `image`, within a `with` block."""
        self._shown, previous = image, self._shown
        try:
            yield
        finally:
            self._shown = previous

    def vectors_of(self, rays: Rays) -> Tensor | None:
        """Return the vector (R, S) of each ray's image; None if rays have no training image."""
        images = rays.camera_indices
        if images is None and self._shown is not None:
            images = torch.full((len(rays),), self._shown, device=rays.origins.device)
        return None if images is None else functional.embedding(images, self.vectors)
