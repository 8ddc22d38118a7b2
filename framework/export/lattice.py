"""The lattice for the search of a surface: points at equal distances in a box, evaluated block by block.

The box may be turned against the scene's axes: a box given in the input's frame is parallel to the input's axes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from nerfloom.base.errors import ConfigError, FlagError
from nerfloom.cameras.poses import Placement

MAX_RESOLUTION = 1024
"""Maximum number of cells along the longest edge of the box."""


@dataclass(frozen=True)
class Lattice:
    """Lattice points (i, j, k), from 0 to the number of cells along each axis, at `corner + (i, j, k) @ axes`."""

    corner: Tensor
    """(3,) float64 position of point (0, 0, 0), scene coordinates."""
    axes: Tensor
    """(3, 3) float64, row a is the step from a point to the next along axis a, scene coordinates. Rows are orthogonal
    and of the same length."""
    cells: tuple[int, int, int]
    """Number of cells along each axis, one less than the number of points."""

    @property
    def spacing(self) -> float:
        """Distance between neighbouring points, scene units."""
        return float(self.axes[0].norm())

    def positions(self, indices: Tensor) -> Tensor:
        """Return the scene coordinates (N, 3) float64 of lattice coordinates `indices` (N, 3), whole or fractional."""
        return self.corner + indices.double() @ self.axes

    def indices(self, positions: Tensor) -> Tensor:
        """Return the lattice coordinates (N, 3) float64 of scene coordinates (N, 3): the inverse of `positions`."""
        return (positions.double() - self.corner) @ self.axes.T / self.spacing**2

    def block_counts(self, edge: int) -> tuple[int, int, int]:
        """Return the number of blocks of `edge` cells along each axis; the last may be smaller."""
        return tuple(-(-count // edge) for count in self.cells)  # type: ignore[return-value]

    def all_blocks(self, edge: int) -> Tensor:
        """Return the indices (B, 3) int64 of all blocks of `edge` cells."""
        ranges = (torch.arange(count) for count in self.block_counts(edge))
        return torch.cartesian_prod(*ranges).view(-1, 3)

    def block_points(self, block: Tensor, edge: int) -> tuple[Tensor, tuple[int, int, int]]:
        """Return the lattice points of a block, including all its faces.

        Args:
            block: (3,) index of the block.
            edge: cells along an edge of a block.

        Returns:
            (N, 3) int64 indices of the points, the last axis fastest, and their number along each axis.
        """
        starts = [int(index) * edge for index in block]
        ends = [min(start + edge, count) for start, count in zip(starts, self.cells, strict=True)]
        axes = [torch.arange(start, end + 1) for start, end in zip(starts, ends, strict=True)]
        x, y, z = (len(axis) for axis in axes)
        return torch.cartesian_prod(*axes), (x, y, z)


def lattice_of(
    box: Tensor,
    resolution: int,
    placement: Placement | None = None,
    low: tuple[float, float, float] | None = None,
    high: tuple[float, float, float] | None = None,
) -> Lattice:
    """Return the lattice of a box.

    Args:
        box: (2, 3) the scene's box, used if neither corner is given.
        resolution: cells along the longest edge; the other edges are rounded up to whole cells.
        placement: the input's in the scene; None if the two frames are the same.
        low, high: corners of another box, with edges parallel to the axes of the input, in its units.

    Raises:
        ConfigError: if the resolution is out of range, or the corners do not make a box.
    """
    if not 1 < resolution <= MAX_RESOLUTION:
        raise FlagError(f"--resolution is {resolution}; it must be from 2 to {MAX_RESOLUTION}")
    if (low is None) != (high is None):
        raise ConfigError("the corners low and high of a box belong together: give both, or none")
    first, last = box.double().cpu()
    axes = torch.eye(3, dtype=torch.float64)
    if low is not None and high is not None:
        first, last = torch.tensor(low, dtype=torch.float64), torch.tensor(high, dtype=torch.float64)
        if not all(a < b for a, b in zip(low, high, strict=True)) or not all(map(math.isfinite, (*low, *high))):
            raise ConfigError(f"the box is empty: its corner {low} must be less than {high} along each axis")
    spacing = float((last - first).max()) / resolution
    x, y, z = (max(math.ceil(float(edge) / spacing - 1e-6), 1) for edge in last - first)
    if low is None or placement is None:
        return Lattice(first, spacing * axes, (x, y, z))
    rotation = placement.transform[:, :3]
    return Lattice(placement.points(first[None])[0], placement.scale * spacing * rotation.T, (x, y, z))
