"""Export of an occupancy grid: which cells of a box a trained model samples."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nerfloom.base.atomic import write_atomically
from nerfloom.base.console import say
from nerfloom.base.errors import ConfigError
from nerfloom.base.extras import require
from nerfloom.cameras.poses import Placement
from nerfloom.data.ply import write_points
from nerfloom.export.mesh import Mesh
from nerfloom.export.mesh_files import write_mesh
from nerfloom.export.settings import OccupancySettings
from nerfloom.renderable import parts
from nerfloom.samplers.base import SkipsCells
from nerfloom.training.loaded import Loaded

GREY = 0.6
"""Colour of cells."""


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
    count = int(innermost(grid).sum())
    write_grid(path, grid, loaded.placement)
    say(f"{grid.resolution}^3 cells, {count:,} occupied: {path}")
    if not count:
        raise ConfigError("no cell is occupied, so that there is nothing to write to occupancy.ply")
    cells = path.with_suffix(".ply")
    write_cells(cells, grid, loaded.placement, settings.cells == "boxes")
    say(f"{count:,} cells: {cells}")


def box_frame(grid: SkipsCells, placement: Placement) -> Tensor:
    """Return the matrix (4, 4) float64 from a grid's unit cube to the input's frame.

    Args:
        grid: the grid, aligned with the axes of the scene, but not always with the axes of the input.
        placement: placement of the input in the scene.
    """
    low, high = grid.box.double().cpu()
    corners = torch.stack([low, *(low + torch.diag(high - low))])
    origin, *ends = placement.original_points(corners)
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] = torch.stack([end - origin for end in ends], dim=-1)
    matrix[:3, 3] = origin
    return matrix


def write_grid(file: Path, grid: SkipsCells, placement: Placement) -> None:
    """Write a grid as a compressed .npz of numpy.

    It holds `occupied` (n, n, n) bool, indexed along x, y and z of the scene; `cube_to_input`
    (4, 4), from the unit cube of the grid to the frame of the input; and `box` (2, 3), the corners of the grid in the
    scene's frame. With nested boxes, these describe the smallest; `larger` (L - 1, n, n, n) has the cells of the
    others, each of twice the size, without the part inside a smaller box.

    Args:
        file: path of the file.
        grid: the grid.
        placement: placement of the input in the scene.

    Raises:
        OSError: if the file cannot be written.
    """
    n = grid.resolution
    arrays: dict[str, Any] = {
        "occupied": innermost(grid).numpy(),
        "cube_to_input": box_frame(grid, placement).numpy(),
        "box": grid.box.cpu().numpy(),
    }
    if grid.levels > 1:
        arrays["larger"] = grid.occupied[n**3 :].cpu().view(-1, n, n, n).numpy()
    write_atomically(file, lambda stream: np.savez_compressed(stream, **arrays))


def innermost(grid: SkipsCells) -> Tensor:
    """Return the cells (n, n, n) bool of the smallest box of `grid` that are occupied at any time, on the CPU."""
    n = grid.resolution
    return grid.occupied_when()[: n**3].cpu().view(n, n, n)


def cell_centers(grid: SkipsCells, placement: Placement) -> Tensor:
    """Return the centres (K, 3) float64 of the occupied cells of `grid`, in the frame of the input of `placement`.

    With nested boxes, these are the cells of the smallest.
    """
    cells, matrix = innermost(grid).nonzero(), box_frame(grid, placement)
    return (cells.double() + 0.5) / grid.resolution @ matrix[:3, :3].T + matrix[:3, 3]


def write_cells(file: Path, grid: SkipsCells, placement: Placement, boxes: bool) -> None:
    """Write the occupied cells, with nested boxes of the smallest box only, to a PLY file.

    Args:
        file: path of the file.
        grid: the grid, with at least one occupied cell.
        placement: placement of the input in the scene.
        boxes: True for the surface of their boxes, without faces between occupied cells; False for their centres.

    Raises:
        OSError: if the file cannot be written.
    """
    if not boxes:
        centers = cell_centers(grid, placement)
        write_points(file, centers, torch.full_like(centers, GREY))
        return
    mesh, matrix = boxes_mesh(grid), box_frame(grid, placement)
    vertices = mesh.vertices @ matrix[:3, :3].T + matrix[:3, 3]
    write_mesh(file, Mesh(vertices, mesh.faces, colors=torch.full_like(vertices, GREY).float()))


def boxes_mesh(grid: SkipsCells) -> Mesh:
    """Return the surface of the occupied cells of `grid`, in its (smallest) box as the unit cube."""
    n = grid.resolution
    padded = torch.nn.functional.pad(innermost(grid), (1,) * 6)
    inner = padded[1:-1, 1:-1, 1:-1]
    quads = []
    for axis in range(3):
        across, up = (axis + 1) % 3, (axis + 2) % 3
        for side in (0, 1):
            beside = padded.roll(1 - 2 * side, axis)[1:-1, 1:-1, 1:-1]
            cells = (inner & ~beside).nonzero()
            cells[:, axis] += side
            steps = torch.zeros(4, 3, dtype=torch.int64)
            steps[[1, 2], across] = 1
            steps[[2, 3], up] = 1
            corners = cells[:, None] + steps
            quads.append(corners if side else corners.flip(1))
    places = torch.cat(quads).view(-1, 3)
    keys = (places[:, 0] * (n + 1) + places[:, 1]) * (n + 1) + places[:, 2]
    unique, owner = keys.unique(return_inverse=True)
    quad = owner.view(-1, 4)
    vertices = torch.stack([unique // (n + 1) ** 2, unique // (n + 1) % (n + 1), unique % (n + 1)], -1).double() / n
    return Mesh(vertices, torch.cat([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]]))
