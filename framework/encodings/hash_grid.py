"""The multiresolution hash grid as a module with its table of features."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, TypeVar

from torch import Tensor, nn

from nerfloom.base.config import Range, TrainConfig
from nerfloom.base.optimised import Optimised
from nerfloom.encodings.coarse_to_fine import OpenLevels
from nerfloom.kernels.grids.hash_grid import LOOK_UP, hash_grid
from nerfloom.kernels.grids.hash_grid_layout import MAX_LEVELS, MAX_LOG2_TABLE_SIZE, MAX_RESOLUTION, HashGridLayout
from nerfloom.kernels.grids.hash_grid_lookup import TableGradient
from nerfloom.kernels.table_memory import table

HashGridT = TypeVar("HashGridT", bound="HashGrid")
FIRST_LEVELS = 4
"""Number of levels open at the start if levels open one after the other, as in Neuralangelo (Li et al. 2023)."""


@dataclass(frozen=True)
class HashGridConfig(TrainConfig):
    """Settings of a method on a hash grid."""

    RANGES: ClassVar[dict[str, Range]] = {
        "num_levels": (1, MAX_LEVELS),
        "features_per_level": (1, 64),
        "base_resolution": (1, MAX_RESOLUTION),
        "max_resolution": (1, MAX_RESOLUTION),
        "log2_table_size": (1, MAX_LOG2_TABLE_SIZE),
    }
    num_levels: int = 16
    """Number of levels of the hash grid."""
    features_per_level: int = 2
    """Features per grid vertex."""
    base_resolution: int = 16
    """Cells per axis at the coarsest level."""
    max_resolution: int = 2_048
    """Cells per axis at the finest level."""
    log2_table_size: int = 18
    """Maximum number of table entries per level, log2."""
    sparse_updates: bool = True
    """Whether Adam updates only the table entries that a step used."""


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
        opening: levels open one after the other (`OpenLevels`) during this fraction of the training budget; 0: all are
            open.

    Raises:
        ConfigError: if a number is out of range, or the table needs more memory than the machine has.
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
        opening: float = 0.0,
    ) -> None:
        super().__init__()
        self.layout = HashGridLayout.build(num_levels, base_resolution, max_resolution, log2_table_size)
        # Small random values, as in section 4 of the paper: features start near zero, but not equal.
        self.table = nn.Parameter(table(self.layout.num_entries, features_per_level).uniform_(-1e-4, 1e-4))
        self.optimised = Optimised("tables", sparse=True) if sparse else None
        self.deferred = TableGradient(LOOK_UP, self.layout) if sparse else None
        self.opening = OpenLevels(num_levels, min(FIRST_LEVELS, num_levels), opening) if opening else None
        self.num_features = num_levels * features_per_level

    @classmethod
    def of(cls: type[HashGridT], config: HashGridConfig, last: float = 0.0) -> HashGridT:
        """Return a grid with the sizes of `config`, decided; `last` is the constructor's last argument."""
        sizes = config.num_levels, config.features_per_level, config.base_resolution, config.max_resolution
        return cls(*sizes, config.log2_table_size, config.sparse_updates, last)

    def forward(self, positions: Tensor) -> Tensor:
        """Return the features (N, L * F) at `positions` (N, 3) in [0, 1]."""
        if self.opening is None or self.opening.complete:
            return self._look_up(positions, self.table, self.layout)
        layout = self.layout.first(self.opening.count)
        features = self._look_up(positions, self.table[: layout.num_entries], layout)
        return self.opening.completed(features, self.num_features)

    def _look_up(self, positions: Tensor, table: Tensor, layout: HashGridLayout) -> Tensor:
        if self.deferred is not None:
            self.deferred.layout = layout
        return hash_grid(positions, table, layout, self.deferred)
