"""Multiresolution hash encoding: Instant-NGP (Mueller et al. 2022), section 3.

Level l is a grid of resolution r_l = floor(r_0 * b^l). A level is stored densely if its vertices fit into its table; a
finer one is hashed (equation 4). The features at a position are interpolated trilinearly between the 8 corners of its
cell.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from nerfloom.geometry.limits import between
from nerfloom.kernels import native
from nerfloom.kernels.dispatch import CPP, FEW_OPERATIONS, TRITON, Operation
from nerfloom.kernels.grids.hash_grid_layout import HashGridLayout
from nerfloom.kernels.grids.hash_grid_lookup import LookUp, TableGradient, fits
from nerfloom.kernels.triton_backend import later

PRIMES = (1, 2654435761, 805459861)
"""Factors of the hash (equation 4)."""
MAX_HELD = 2**26
"""Maximum number of corner features held at once in the form with few operations; it processes positions in parts."""


def corners(positions: Tensor, layout: HashGridLayout, level: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return the 8 corners of the cell of each position at one level.

    Args:
        positions: (N, 3); coordinates are clamped to [0, 1]. NaN is in cell 0, with weights of NaN.
        layout: resolutions and offsets of the levels.
        level: index of the level.

    Returns:
        entries (8, N) int32, counted from the first entry of the level; trilinear weights (8, N); and positions in the
        cell (3, N) in [0, 1]. Corner c is at (c >> 2 & 1, c >> 1 & 1, c & 1) along x, y, z.
    """
    resolution = layout.resolutions[level]
    scaled = between(positions.t(), 0.0, 1.0) * resolution
    cell = scaled.detach().nan_to_num().floor().clamp(max=resolution - 1)  # x = 1 belongs to the last cell
    fractions = scaled - cell
    if layout.is_dense(level):
        x, y, z = _both_ends(cell.int(), ((resolution + 1) ** 2, resolution + 1, 1))
        entries = x + y + z
    else:
        x, y, z = _both_ends(cell.int(), PRIMES)  # the products wrap around in int32, as the hash requires
        entries = (x ^ y ^ z) & (layout.offsets[level + 1] - layout.offsets[level] - 1)
    wx, wy, wz = (torch.stack([1 - f, f]) for f in fractions)
    weights = wx[:, None, None] * wy[:, None] * wz
    return entries.flatten(0, 2), weights.flatten(0, 2), fractions


def _both_ends(cell: Tensor, strides: tuple[int, ...]) -> tuple[Tensor, Tensor, Tensor]:
    """Return the cell's two ends along x, y, z times the stride of the axis, which broadcast to (2, 2, 2, N)."""
    x, y, z = (torch.stack([row * s, row * s + s]) for row, s in zip(cell, _signed(strides), strict=True))
    return x[:, None, None], y[:, None], z


def _signed(strides: tuple[int, ...]) -> tuple[int, ...]:
    """Return the int32 values with the same bits."""
    return tuple((stride + 2**31) % 2**32 - 2**31 for stride in strides)


def hash_grid_reference(
    positions: Tensor, table: Tensor, layout: HashGridLayout, deferred: TableGradient | None = None
) -> Tensor:
    """Compute `hash_grid` of `positions`, `table` and `layout` in PyTorch; `deferred` is not used."""
    features = []
    for level, offset in enumerate(layout.offsets[:-1]):
        entries, weights, _ = corners(positions, layout, level)
        features.append((table[entries.long() + offset] * weights[..., None]).sum(0))
    return torch.cat(features, dim=-1)


_forward = native.Function("hash_grid_forward", "pqpippipi")
_backward_table = native.Function("hash_grid_backward_table", "pppiippipi")
_backward_positions = native.Function("hash_grid_backward_positions", "pqppippipi")
_adam = native.Function("hash_grid_adam", "pppiippippppfddfi", "q")
LOOK_UP = LookUp("hash_grid", "positions", ("N", 3), _forward, _backward_table, _backward_positions, _adam)
"""The look-up of positions."""


def hash_grid(
    positions: Tensor, table: Tensor, layout: HashGridLayout, deferred: TableGradient | None = None
) -> Tensor:
    """Return the multiresolution hash encoding of positions: Instant-NGP, section 3.

    The compiled form has first derivatives only.

    Args:
        positions: (N, 3); coordinates are clamped to [0, 1].
        table: (E, F) entries of all levels, E = layout.num_entries.
        layout: resolutions and offsets of the levels.
        deferred: collects the gradient of the table in the compiled form, instead of autograd; None for autograd.

    Returns:
        (N, L * F) features of the type of `table`, level by level.

    Raises:
        ValueError: if a shape does not fit the layout.
    """
    LOOK_UP.check(positions, table, layout)
    positions = positions.to(table.dtype)
    return HASH_GRID((positions, table), positions, table, layout, deferred)


HASH_GRID: Operation[..., Tensor] = Operation(LOOK_UP.name, hash_grid_reference)
HASH_GRID.implementation(CPP, fits=fits)(LOOK_UP.compiled)
HASH_GRID.implementation(TRITON, fits=fits)(later("grids.hash_grid_triton", "hash_grid"))


class _Levels(NamedTuple):
    """Constants of all levels on a device, shaped for operations with positions."""

    cells: Tensor
    """(L, 1, 1) number of cells along each axis."""
    strides: Tensor
    """(L, 3, 1) int32 factor of the vertex's index along each axis."""
    dense: Tensor
    """(L, 1, 1, 1, 1) bool, whether each vertex has its own entry."""
    masks: Tensor
    """(L, 1, 1, 1, 1) int32 mask of the hash bits in use."""
    offsets: Tensor
    """(L, 1, 1, 1, 1) int32 index of the first entry."""


@lru_cache(maxsize=64)
def _levels(layout: HashGridLayout, dtype: torch.dtype, device: torch.device) -> _Levels:
    """Return the constants; cached, because a copy to the device waits for it."""
    sizes = [end - first for first, end in pairwise(layout.offsets)]
    dense = [layout.is_dense(level) for level in range(layout.num_levels)]
    strides = [
        ((cells + 1) ** 2, cells + 1, 1) if own else _signed(PRIMES)
        for cells, own in zip(layout.resolutions, dense, strict=True)
    ]
    shape = (-1, 1, 1, 1, 1)
    return _Levels(
        torch.tensor(layout.resolutions, dtype=dtype, device=device).view(-1, 1, 1),
        torch.tensor(strides, dtype=torch.int32, device=device)[:, :, None],
        torch.tensor(dense, device=device).view(shape),
        torch.tensor([size - 1 for size in sizes], dtype=torch.int32, device=device).view(shape),
        torch.tensor(layout.offsets[:-1], dtype=torch.int32, device=device).view(shape),
    )


@HASH_GRID.implementation(  # with indices in 32 bits
    FEW_OPERATIONS, types=None, order=torch.inf, fits=lambda *given: given[2].num_entries < 2**31
)
def _all_levels(positions: Tensor, table: Tensor, layout: HashGridLayout, deferred: TableGradient | None) -> Tensor:
    """Compute `hash_grid` with one set of operations for all levels, for any device and float type."""
    held = 8 * layout.num_levels * table.shape[1]
    parts = positions.split(max(MAX_HELD // held, 1))
    found = [_at_all_levels(part, table, layout) for part in parts]
    return found[0] if len(found) == 1 else torch.cat(found)


def _at_all_levels(positions: Tensor, table: Tensor, layout: HashGridLayout) -> Tensor:
    levels = _levels(layout, positions.dtype, positions.device)
    scaled = between(positions.t(), 0.0, 1.0) * levels.cells  # (L, 3, N)
    cell = torch.minimum(scaled.detach().nan_to_num().floor(), levels.cells - 1)
    fractions, low = scaled - cell, cell.int() * levels.strides
    x, y, z = _spread(torch.stack([low, low + levels.strides], 2))
    entries = torch.where(levels.dense, x + y + z, (x ^ y ^ z) & levels.masks) + levels.offsets
    wx, wy, wz = _spread(torch.stack([1 - fractions, fractions], 2))
    # index_select adds its gradient in place; on a GPU the gradient of table[entries] would be sorted first.
    rows = table.index_select(0, entries.flatten()).view(layout.num_levels, 8, len(positions), table.shape[1])
    features = (rows * (wx * wy * wz).flatten(1, 3)[..., None]).sum(1)
    return features.transpose(0, 1).flatten(1)


def _spread(ends: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the values (L, 3, 2, N) at a cell's two ends along x, y, z, which broadcast to (L, 2, 2, 2, N)."""
    x, y, z = ends.unbind(1)
    return x[:, :, None, None], y[:, None, :, None], z[:, None, None]
