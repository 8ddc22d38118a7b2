"""The multiresolution hash grid, with its table."""

from __future__ import annotations

from torch import Tensor, nn

from framework.base.optimised import Optimised
from framework.kernels.hash_grid import HashGridLayout, TableGradient, hash_grid
from framework.kernels.memory import table


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
        self.optimised = Optimised("tables", sparse=True) if sparse else None
        self.deferred = TableGradient(self.layout) if sparse else None
        self.num_features = num_levels * features_per_level

    def forward(self, positions: Tensor) -> Tensor:
        """Positions (N, 3) in [0, 1] to features (N, L * F)."""
        return hash_grid(positions, self.table, self.layout, self.deferred)
