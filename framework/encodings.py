"""Encodings that hold parameters. Those without are functions in `framework.kernels`."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from framework.kernels.hash_grid import HashGridLayout, TableGradient, hash_grid
from framework.kernels.memory import table
from framework.kernels.planes import PlanesGradient, PlanesLayout, planes


class HashGrid(nn.Module):
    """Multiresolution hash grid over [0, 1]^3 (Instant-NGP, section 3).

    Args:
        num_levels: L.
        features_per_level: F.
        base_resolution, max_resolution: cells along an axis at the first and last level.
        log2_table_size: largest table of one level, as a power of two.
        sparse: updates touch only the entries that a step used. Compiled, the table's gradient then waits in
            `deferred` for the optimiser, and `table.grad` stays None.
    """

    dims = 3

    def __init__(
        self,
        num_levels: int = 16,
        features_per_level: int = 2,
        base_resolution: int = 16,
        max_resolution: int = 2048,
        log2_table_size: int = 19,
        sparse: bool = False,
    ) -> None:
        super().__init__()
        self.layout = HashGridLayout.build(num_levels, base_resolution, max_resolution, log2_table_size)
        # Small random values, as in the paper's section 4: features start near zero but not alike.
        self.table = nn.Parameter(table(self.layout.num_entries, features_per_level).uniform_(-1e-4, 1e-4))
        self.deferred = TableGradient(self.layout) if sparse else None
        self.num_features = num_levels * features_per_level

    def forward(self, positions: Tensor, known: Tensor | None = None) -> Tensor:
        """Positions (N, 3) in [0, 1] to features (N, L * F), which may be `known` already (see `hash_grid`)."""
        return hash_grid(positions, self.table, self.layout, self.deferred, known)


class FeaturePlanes(nn.Module):
    """Multiscale feature planes over [0, 1]^D (K-Planes, section 3); a fourth axis is time.

    Args:
        resolutions: vertices along each axis, per scale.
        features_per_scale: F.
        sparse: updates touch only the entries that a step used, as for `HashGrid`.
    """

    def __init__(self, resolutions: tuple[tuple[int, ...], ...], features_per_scale: int, sparse: bool = False) -> None:
        super().__init__()
        self.layout = PlanesLayout.build(resolutions)
        self.dims = self.layout.dims
        # As in section 4.1's implementation: products start neither at zero nor at one; time changes nothing at first.
        self.table = nn.Parameter(table(self.layout.num_entries, features_per_scale).uniform_(0.1, 0.5))
        with torch.no_grad():
            for scale in range(self.layout.num_scales):
                for index, axes in enumerate(self.layout.axes):
                    if 3 in axes:
                        self.layout.plane(self.table, scale, index).fill_(1)
        self.deferred = PlanesGradient(self.layout) if sparse else None
        self.num_features = self.layout.num_scales * features_per_scale

    def forward(self, positions: Tensor, known: Tensor | None = None) -> Tensor:
        """Positions (N, D) in [0, 1] to features (N, S * F), which may be `known` already (see `planes`)."""
        return planes(positions, self.table, self.layout, self.deferred, known)
