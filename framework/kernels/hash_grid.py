"""Multiresolution hash encoding: Instant-NGP (Mueller et al. 2022), section 3.

Level l is a grid of resolution r_l = floor(r_0 * b^l). A level whose vertices fit into its table is stored densely; a
finer one is hashed (equation 4). The features at a position are interpolated trilinearly between the 8 corners of its
cell.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import accumulate, pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor

from framework.kernels import kept, memory, native
from framework.kernels.deferred import Parts, waiting
from framework.kernels.dispatch import CPP, FEW_OPERATIONS, TRITON, Operation
from framework.kernels.hash_grid_layout import HashGridLayout as HashGridLayout
from framework.kernels.triton_kernels import later

PRIMES = (1, 2654435761, 805459861)
"""Factors of the hash (equation 4)."""
MAX_HELD = 2**26
"""Maximum number of features at corners that the form in few operations holds at once; it takes positions in parts."""


def corners(positions: Tensor, layout: HashGridLayout, level: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return the 8 corners of the cell of each position at one level.

    Args:
        positions: (N, 3); coordinates are clamped to [0, 1]. NaN is in cell 0, with weights of NaN.
        layout: resolutions and offsets of the levels.
        level: number of the level.

    Returns:
        entries (8, N) int32, counted from the first entry of the level; trilinear weights (8, N); and positions in the
        cell (3, N) in [0, 1]. Corner c is at (c >> 2 & 1, c >> 1 & 1, c & 1) along x, y, z.
    """
    resolution = layout.resolutions[level]
    scaled = positions.t().clamp(0, 1) * resolution
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


def hash_grid_reference(positions: Tensor, table: Tensor, layout: HashGridLayout) -> Tensor:
    """Compute `hash_grid` in PyTorch, for any device and float type, with derivatives of any order.

    Args:
        positions: (N, 3); coordinates are clamped to [0, 1].
        table: (E, F) entries of all levels.
        layout: resolutions and offsets of the levels.

    Returns:
        (N, L * F) features, level by level.
    """
    features = []
    for level, offset in enumerate(layout.offsets[:-1]):
        entries, weights, _ = corners(positions, layout, level)
        features.append((table[entries.long() + offset] * weights[..., None]).sum(0))
    return torch.cat(features, dim=-1)


_forward = native.Function("hash_grid_forward", "pqpippipi")
_backward_table = native.Function("hash_grid_backward_table", "pppiippipi")
_backward_positions = native.Function("hash_grid_backward_positions", "pqppippipi")
_adam = native.Function("hash_grid_adam", "pppiippippppfddfi", "q")


class TableGradient:
    """The deferred gradient of a table: gradients of encodings, collected in backward passes and not yet accumulated.

    A step uses few entries. Accumulating the gradient level by level, each followed by Adam, takes one pass over the
    table, while autograd's dense gradient takes many.

    Args:
        layout: resolutions and offsets of the levels that are looked up: all of the table's, or the first ones.
    """

    _add, _adam = _backward_table, _adam
    """The compiled functions that accumulate the gradient, and that apply it."""

    def __init__(self, layout: HashGridLayout) -> None:
        self.layout = layout
        self.parts: Parts = []
        """Positions (N, 3) of each encoding, and gradient (N, L * F) of its result."""
        self._sum: Tensor | None = None

    @property
    def pending(self) -> bool:
        """True if there is a gradient."""
        return bool(self.parts)

    def clear(self) -> None:
        """Discard the gradient."""
        self.parts.clear()

    @property
    def gradients(self) -> list[Tensor]:
        """The collected gradients (N, L * F) of encodings."""
        return [grad for _, grad in self.parts]

    def _arguments(self, features: int) -> tuple[Any, ...]:
        ends = tuple(accumulate(len(positions) for positions, _ in self.parts))
        positions = [native.pointer(x, "positions", (len(x), 3)) for x, _ in self.parts]
        width = self.layout.num_levels * features
        grads = [native.pointer(g, "the gradient", (len(x), width)) for x, g in self.parts]
        layout = (*self.layout.arrays, self.layout.num_levels)
        return native.pointers(positions), native.pointers(grads), native.integers(ends), len(ends), features, *layout

    def add_to(self, grad: Tensor) -> None:
        """Add the gradient to `grad` (E, F), and discard it."""
        shape = (self.layout.num_entries, grad.shape[1])
        into = native.pointer(grad[: shape[0]], "the table's gradient", shape)
        self._add(*self._arguments(shape[1]), into, native.threads())
        self.parts.clear()

    def summed(self, table: Tensor) -> Tensor:
        """Return the accumulated gradient (E, F) of `table`, and discard it.

        The result's memory is used again: its entries must be zero before the next call, as Adam leaves them.
        """
        if self._sum is None:
            self._sum = memory.table(*table.shape)
        self.add_to(self._sum)
        return self._sum

    def adam(
        self, table: Tensor, mean: Tensor, square: Tensor, seen: Tensor,
        rate: float, betas: tuple[float, float], eps: float,
    ) -> int:  # fmt: skip
        """Update `table` (E, F) by `framework.kernels.adam.sparse_adam` with this gradient, and discard the gradient.

        `mean`, `square`, `seen`, `rate`, `betas`, `eps` and the result are as in `sparse_adam`.
        """
        shape = (self.layout.num_entries, table.shape[1])
        table, mean, square, seen = (values[: shape[0]] for values in (table, mean, square, seen))
        updated: int = self._adam(
            *self._arguments(shape[1]), native.pointer(table, "the table", shape), native.pointer(mean, "mean", shape),
            native.pointer(square, "square", shape), native.pointer(seen, "seen", shape[:1]), rate, *betas, eps,
            native.threads(),
        )  # fmt: skip
        self.parts.clear()
        return updated


class _HashGrid(torch.autograd.Function):
    """The compiled form of `hash_grid`."""

    @staticmethod
    def forward(
        ctx: Any,
        positions: Tensor,
        table: Tensor,
        placeholder: Tensor | None,
        layout: HashGridLayout,
    ) -> Tensor:
        count, features = len(positions), table.shape[1]
        points = native.pointer(positions, "positions", (count, 3))
        entries = native.pointer(table, "the hash table", (layout.num_entries, features))

        def compute() -> Tensor:
            out = positions.new_empty(count, layout.num_levels * features)
            _forward(
                points, count, entries, features, *layout.arrays, layout.num_levels, out.data_ptr(), native.threads()
            )
            return out

        ctx.save_for_backward(positions, table)
        ctx.layout = layout
        return kept.result(("hash_grid", layout), (positions,), (table,), compute)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        positions, table = ctx.saved_tensors
        layout, count, features = ctx.layout, len(positions), table.shape[1]
        grad = grad.contiguous()
        incoming = native.pointer(grad, "the gradient", (count, layout.num_levels * features))
        grad_positions = grad_table = None
        if ctx.needs_input_grad[1]:
            grad_table = torch.zeros_like(table)
            gradient = TableGradient(layout)
            gradient.parts.append((positions, grad))
            gradient.add_to(grad_table)
        if ctx.needs_input_grad[0]:
            grad_positions = torch.empty_like(positions)
            _backward_positions(
                positions.data_ptr(), count, table.data_ptr(), incoming, features, *layout.arrays,
                layout.num_levels, grad_positions.data_ptr(), native.threads(),
            )  # fmt: skip
        return grad_positions, grad_table, grad if ctx.needs_input_grad[2] else None, None


def hash_grid(
    positions: Tensor,
    table: Tensor,
    layout: HashGridLayout,
    deferred: TableGradient | None = None,
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
    if positions.ndim != 2 or positions.shape[1] != 3:
        raise ValueError(f"hash_grid: positions have shape {tuple(positions.shape)}, not (N, 3)")
    if table.ndim != 2 or table.shape[0] != layout.num_entries:
        raise ValueError(f"hash_grid: the table has shape {tuple(table.shape)}, not ({layout.num_entries}, F)")
    positions = positions.to(table.dtype)
    return HASH_GRID((positions, table), positions, table, layout, deferred)


def _reference(positions: Tensor, table: Tensor, layout: HashGridLayout, deferred: TableGradient | None) -> Tensor:
    return hash_grid_reference(positions, table, layout)


HASH_GRID = Operation("hash_grid", _reference)


def _fits(positions: Tensor, table: Tensor, layout: HashGridLayout, deferred: TableGradient | None) -> bool:
    return table.shape[1] in (1, 2, 4, 8)


@HASH_GRID.implementation(CPP, fits=_fits)
def _compiled(positions: Tensor, table: Tensor, layout: HashGridLayout, deferred: TableGradient | None) -> Tensor:
    positions, table, placeholder = positions.contiguous(), table.contiguous(), None
    if deferred is not None and table.requires_grad:
        placeholder = waiting(table, positions, layout.num_levels * table.shape[1], deferred.parts)
        table = table.detach()
    return _HashGrid.apply(positions, table, placeholder, layout)


HASH_GRID.implementation(TRITON, fits=_fits)(later("hash_grid", "hash_grid"))


class _Levels(NamedTuple):
    """Constants of all levels on a device, in the shapes in which they are combined with positions."""

    cells: Tensor
    """(L, 1, 1) number of cells along each axis."""
    strides: Tensor
    """(L, 3, 1) int32 factor of the vertex's index along each axis."""
    dense: Tensor
    """(L, 1, 1, 1, 1) bool, whether each vertex has an entry of its own."""
    masks: Tensor
    """(L, 1, 1, 1, 1) int32 bits of a hash that are used."""
    offsets: Tensor
    """(L, 1, 1, 1, 1) int32 index of the first entry."""


@lru_cache(maxsize=64)
def _levels(layout: HashGridLayout, dtype: torch.dtype, device: torch.device) -> _Levels:
    """Return the constants; they are kept, since bringing them to a device means to wait for it."""
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


def _has_int32_indices(
    positions: Tensor, table: Tensor, layout: HashGridLayout, deferred: TableGradient | None
) -> bool:
    return layout.num_entries < 2**31


@HASH_GRID.implementation(FEW_OPERATIONS, types=None, order=torch.inf, fits=_has_int32_indices)
def _all_levels(positions: Tensor, table: Tensor, layout: HashGridLayout, deferred: TableGradient | None) -> Tensor:
    """Compute `hash_grid` with one set of operations for all levels, for any device and float type."""
    held = 8 * layout.num_levels * table.shape[1]
    parts = positions.split(max(MAX_HELD // held, 1))
    found = [_at_all_levels(part, table, layout) for part in parts]
    return found[0] if len(found) == 1 else torch.cat(found)


def _at_all_levels(positions: Tensor, table: Tensor, layout: HashGridLayout) -> Tensor:
    levels = _levels(layout, positions.dtype, positions.device)
    scaled = positions.t().clamp(0, 1) * levels.cells  # (L, 3, N)
    cell = torch.minimum(scaled.detach().nan_to_num().floor(), levels.cells - 1)
    fractions, low = scaled - cell, cell.int() * levels.strides
    x, y, z = _spread(torch.stack([low, low + levels.strides], 2))
    entries = torch.where(levels.dense, x + y + z, (x ^ y ^ z) & levels.masks) + levels.offsets
    wx, wy, wz = _spread(torch.stack([1 - fractions, fractions], 2))
    # By index_select, whose gradient is added up in place; that of table[entries] is sorted first on a GPU.
    rows = table.index_select(0, entries.flatten()).view(layout.num_levels, 8, len(positions), table.shape[1])
    features = (rows * (wx * wy * wz).flatten(1, 3)[..., None]).sum(1)
    return features.transpose(0, 1).flatten(1)


def _spread(ends: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the values (L, 3, 2, N) at a cell's two ends along x, y, z, which broadcast to (L, 2, 2, 2, N)."""
    x, y, z = ends.unbind(1)
    return x[:, :, None, None], y[:, None, :, None], z[:, None, None]
