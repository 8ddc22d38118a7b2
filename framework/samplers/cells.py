"""Cells of occupancy grids by index: their positions, their neighbours, and densities at positions inside them."""

from __future__ import annotations

import torch
from torch import Tensor

from nerfloom.fields.base import DensityFunction
from nerfloom.geometry.points import Points

CHUNK = 2**15
"""Number of positions evaluated at once."""


def places(cells: Tensor, resolution: int) -> Tensor:
    """Return box or slice, and coordinates along x, y and z, (N, 4) int32 of cells.

    Args:
        cells: (N,) indices of cells, counted box by box or slice by slice, along z first.
        resolution: cells along each axis.
    """
    n, narrow = resolution, cells.int()  # int32 division takes half the time
    rows, columns = narrow // n, narrow // n**2
    return torch.stack([columns // n, columns % n, rows % n, narrow % n], dim=-1)


def beside(cells: Tensor, resolution: int, parts: int, in_time: bool) -> Tensor:
    """Return a random neighbour (N,) int64 of each of `cells` (N,), or the cell itself.

    Each of `parts` boxes or slices has this `resolution`; only if `in_time`, neighbours include adjacent slices.
    """
    n, place = resolution, places(cells, resolution).long()
    moved = place if in_time else place[:, 1:]
    moved += torch.randint(-1, 2, moved.shape, device=cells.device)
    place[:, 0].clamp_(0, parts - 1)
    place[:, 1:].clamp_(0, n - 1)
    return ((place[:, 0] * n + place[:, 1]) * n + place[:, 2]) * n + place[:, 3]


def densities_at(density: DensityFunction, positions: Tensor, times: Tensor | None = None) -> Tensor:
    """Return the `density` (N,) at `positions` (N, 3) and `times`, in chunks, as large results are slow to allocate."""
    parts = positions.split(CHUNK)
    part_times = [None] * len(parts) if times is None else times.split(CHUNK)
    return torch.cat([density(Points(part, t))[0] for part, t in zip(parts, part_times, strict=True)])


def densities_over_time(
    density: DensityFunction, positions: Tensor, starts: Tensor, length: float, looks: int
) -> Tensor:
    """Return the maximum density (N,) over random times, one in each of several equal parts of a time slice.

    Args:
        density: the density.
        positions: (N, 3) scene coordinates.
        starts: (N,) start times of the positions' slices, in [0, 1].
        length: length of a slice.
        looks: number of parts; 0 for a static scene.
    """
    if not looks:
        return densities_at(density, positions)
    found = []
    for part in range(looks):
        shares = (part + torch.rand(len(positions), device=positions.device)) / looks
        found.append(densities_at(density, positions, starts + shares * length))
    return torch.stack(found).amax(0)
