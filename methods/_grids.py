"""Settings and optimiser of methods with networks that hash grids with small networks can replace."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from nerfloom.base.config import AT_LEAST_0, Range
from nerfloom.base.decisions import Choice
from nerfloom.base.optimised import Optimised
from nerfloom.data.scene import Scene
from nerfloom.encodings.hash_grid import HashGridConfig

SMALL_TABLE, LARGE_TABLE, SMALL_UP_TO = 17, 19, 512
"""Base-2 logarithms of the entries of a level, and the largest number of finest cells along an axis for the first."""
GRID_WIDTH = 64
"""Features per hidden layer of the networks on the grids."""


@dataclass(frozen=True)
class GridsConfig(HashGridConfig):
    """Settings of the hash grids that `--encoding hash-grid` selects."""

    RANGES: ClassVar[dict[str, Range]] = {"grid_learning_rate": AT_LEAST_0}
    GONE: ClassVar[dict[str, Any]] = {"grid_width": GRID_WIDTH}
    grid_learning_rate: float = 1e-2
    """Initial learning rate of the hash grids and of the networks on them (hash-grid)."""


def grid_optimiser(config: GridsConfig, name: str = "grids") -> Optimised:
    """Return the optimiser settings of hash grids and their networks.

    Args:
        name: name of the parameter group.
    """
    return Optimised(name, config.grid_learning_rate, betas=(0.9, 0.99), eps=1e-15, schedule="hold-exponential")


def finest_cells(scene: Scene, per_pixel: int = 1) -> Choice:
    """Return the cells along an axis at the finest level: the next power of two that gives each pixel enough.

    Args:
        per_pixel: minimum number of cells per pixel of the images' longer side.
    """
    cells = 2 ** (per_pixel * scene.image_size - 1).bit_length()
    reason = f"each of the images' {scene.image_size} pixels gets {per_pixel} or more"
    return Choice("max_resolution", cells, reason, "finest cells along an axis")


def table_of_surface(cells: int) -> Choice:
    """Return the size of tables for a surface that meets about the square of the number of finest cells along an axis.

    Args:
        cells: that number.
    """
    size = SMALL_TABLE if cells <= SMALL_UP_TO else LARGE_TABLE
    return Choice("log2_table_size", size, f"a surface meets about {cells}^2 of the finest cells")
