"""What differs between photographs of one scene: light, exposure, camera. NeRF-W (Martin-Brualla et al. 2021)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor, nn
from torch.nn import functional


class Appearance(nn.Module):
    """A learnt vector for each photograph, fed to the colour network: NeRF-W, section 4.1.

    Args:
        size: D.
        count: photographs.
    """

    def __init__(self, size: int, count: int) -> None:
        super().__init__()
        self.vectors = nn.Parameter(torch.zeros(count, size))
        self._shown: Tensor | None = None

    def forward(self, camera_indices: Tensor | None, count: int) -> Tensor:
        """(N, D) of the photographs `camera_indices` (N,); of None, what is `shown` or else the mean, N times."""
        if camera_indices is not None:
            # Not `vectors[camera_indices]`, whose gradient is added up in whatever order threads come.
            return functional.embedding(camera_indices, self.vectors)
        return (self.vectors.mean(0) if self._shown is None else self._shown).expand(count, -1)

    @contextmanager
    def shown(self, vector: Tensor) -> Iterator[None]:
        """Photographs that were not trained on look like `vector` (D,) for a while."""
        self._shown, before = vector, self._shown
        try:
            yield
        finally:
            self._shown = before
