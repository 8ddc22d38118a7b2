"""The multiresolution hash grid as a module with its table of features."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from framework.base.optimised import Optimised
from framework.kernels.hash_grid import HashGridLayout, TableGradient, hash_grid
from framework.kernels.memory import table


class HashGrid(nn.Module):
    """A multiresolution hash grid over [0, 1]^3: Instant-NGP (Mueller et al. 2022), section 3.

    Args:
        num_levels: number L of levels.
        features_per_level: number F of features of an entry.
        base_resolution: cells along an axis at the first level.
        max_resolution: cells along an axis at the last level.
        log2_table_size: maximum number of entries of one level, as a power of two.
        sparse: whether the optimiser updates only the entries that a step has used. The compiled kernels then keep the
            gradient of the table in `deferred` for the optimiser, and `table.grad` stays None.

    Raises:
        ConfigError: if a number is out of range, or the table needs more memory than the machine has.
    """

    dims = 3
    resolutions: Tensor
    """(L,) cells along an axis, for each level."""

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
        # Small random values, as in section 4 of the paper: features start near zero, but not equal.
        self.table = nn.Parameter(table(self.layout.num_entries, features_per_level).uniform_(-1e-4, 1e-4))
        self.optimised = Optimised("tables", sparse=True) if sparse else None
        self.deferred = TableGradient(self.layout) if sparse else None
        self.num_features = num_levels * features_per_level
        self.register_buffer("resolutions", torch.tensor(self.layout.resolutions), persistent=False)

    def forward(self, positions: Tensor) -> Tensor:
        """Return the features (N, L * F) at `positions` (N, 3) in [0, 1]."""
        return hash_grid(positions, self.table, self.layout, self.deferred)
