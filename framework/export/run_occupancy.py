"""The occupancy grid of a run as files."""

from __future__ import annotations

from pathlib import Path

from nerfloom.base.console import say
from nerfloom.base.errors import ConfigError
from nerfloom.base.extras import require
from nerfloom.export.occupancy import write_cells, write_grid
from nerfloom.export.settings import OccupancySettings
from nerfloom.renderable import parts
from nerfloom.samplers.base import SkipsCells
from nerfloom.training.loaded import Loaded


def export_occupancy(loaded: Loaded, path: Path, settings: OccupancySettings) -> None:
    """Write the occupancy grid of `loaded` to `path`, .npz, and its cells as PLY beside it, by `settings`.

    Raises:
        ConfigError: if the run has no grid, no cell is occupied, or packages are missing.
    """
    grids = parts(loaded.model, SkipsCells)
    if not grids:
        raise ConfigError(f"ns-export occupancy: this run of {loaded.method} has no occupancy grid")
    if settings.cells == "boxes":
        require("export", "--cells boxes needs", "; or take --cells centers")
    grid = grids[0]
    count = int(grid.occupied_when()[: grid.resolution**3].sum())
    write_grid(path, grid, loaded.placement)
    say(f"{grid.resolution}^3 cells, {count:,} occupied: {path}")
    if not count:
        raise ConfigError("no cell is occupied, so that there is nothing to write to occupancy.ply")
    cells = path.with_suffix(".ply")
    write_cells(cells, grid, loaded.placement, settings.cells == "boxes")
    say(f"{count:,} cells: {cells}")
