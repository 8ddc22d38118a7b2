"""Multiresolution hash encoding: Instant-NGP (Mueller et al. 2022), section 3.

Level l is a grid of resolution r_l = floor(r_0 * b^l). A level whose vertices fit into its table is stored
densely; a finer one is hashed (equation 4). A position's feature is the trilinear blend of its cell's 8 corners.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate, pairwise
from typing import Any

import torch
from torch import Tensor

from framework.base.errors import ConfigError, shown
from framework.kernels import kept, native
from framework.kernels.adam import all_finite
from framework.kernels.deferred import Parts, waiting
from framework.kernels.dispatch import CPP, Operation

PRIMES = (1, 2654435761, 805459861)
MAX_LEVELS = 64
MAX_RESOLUTION = 2**20
"""Cells along an axis: float32 has 4 bits left for where in such a cell a position lies."""
MAX_LOG2_TABLE_SIZE = 28
"""Entries of a level, as a power of two: 32 bits tell them apart."""


@dataclass(frozen=True)
class HashGridLayout:
    """Where each level's entries stand in the one table (E, F) that all levels share.

    Raises: ConfigError where levels or their entries are none that a grid can have: the kernels rely on it.
    """

    resolutions: tuple[int, ...]
    """Cells along each axis, per level."""
    offsets: tuple[int, ...]
    """First entry of each level; one more than there are levels, the last being E."""

    def __post_init__(self) -> None:
        _check("levels", len(self.resolutions), MAX_LEVELS)
        if len(self.offsets) != len(self.resolutions) + 1 or self.offsets[0] != 0:
            raise ConfigError(f"a hash grid of {len(self.resolutions)} levels has one offset more, the first being 0")
        for resolution, (first, end) in zip(self.resolutions, pairwise(self.offsets), strict=True):
            _check("cells along an axis", resolution, MAX_RESOLUTION)
            _check("entries of a level", end - first, 2**MAX_LOG2_TABLE_SIZE)
            if (resolution + 1) ** 3 > end - first and (end - first) & (end - first - 1):
                raise ConfigError(f"a hash grid's level of {end - first} entries is hashed: it needs a power of two")

    @classmethod
    def build(cls, num_levels: int, base_resolution: int, max_resolution: int, log2_table_size: int) -> HashGridLayout:
        """Resolutions grow geometrically from base to max (equations 2 and 3).

        Raises: ConfigError where a size is beyond MAX_LEVELS, MAX_RESOLUTION or MAX_LOG2_TABLE_SIZE, or less than 1.
        """
        _check("levels", num_levels, MAX_LEVELS)
        _check("cells along an axis", base_resolution, MAX_RESOLUTION)
        _check("cells along an axis", max_resolution, MAX_RESOLUTION)
        _check("for log2 of a level's entries", log2_table_size, MAX_LOG2_TABLE_SIZE)
        growth = (max_resolution / base_resolution) ** (1 / max(num_levels - 1, 1))
        resolutions = tuple(int(base_resolution * growth**level + 1e-6) for level in range(num_levels))
        sizes = [min((resolution + 1) ** 3, 2**log2_table_size) for resolution in resolutions]
        offsets = [0]
        for size in sizes:
            offsets.append(offsets[-1] + (size + 7) // 8 * 8)
        return cls(resolutions, tuple(offsets))

    @property
    def num_entries(self) -> int:
        return self.offsets[-1]

    @property
    def num_levels(self) -> int:
        return len(self.resolutions)

    @cached_property
    def arrays(self) -> tuple[Any, Any]:
        """Resolutions and offsets as C arrays."""
        return native.integers(self.resolutions), native.integers(self.offsets)

    def is_dense(self, level: int) -> bool:
        """Whether each vertex of a level has an entry of its own."""
        return (self.resolutions[level] + 1) ** 3 <= self.offsets[level + 1] - self.offsets[level]


def _check(what: str, count: int, most: int) -> None:
    """Refuse a count that is no whole number from 1 to `most`."""
    if not isinstance(count, int) or not 1 <= count <= most:
        raise ConfigError(f"a hash grid has 1 to {most} {what}, not {shown(count)}")


def corners(positions: Tensor, layout: HashGridLayout, level: int) -> tuple[Tensor, Tensor, Tensor]:
    """The 8 corners of the cell that each position lies in, at one level.

    Args:
        positions: (N, 3); what lies outside [0, 1] is moved to the face. NaN is in cell 0, with NaN for weights.
    Returns: entries (8, N) int32 counted from the level's first one, trilinear weights (8, N), and the
        fractions (3, N) they are made of. Corner c is at (c >> 2 & 1, c >> 1 & 1, c & 1) along x, y, z.
    """
    resolution = layout.resolutions[level]
    scaled = positions.t().clamp(0, 1) * resolution
    cell = scaled.detach().nan_to_num().floor().clamp(max=resolution - 1)  # x = 1 belongs to the last cell
    fractions = scaled - cell
    if layout.is_dense(level):
        x, y, z = _both_ends(cell.int(), ((resolution + 1) ** 2, resolution + 1, 1))
        entries = x + y + z
    else:
        x, y, z = _both_ends(cell.int(), PRIMES)  # products wrap around in int32, as the hash wants
        entries = (x ^ y ^ z) & (layout.offsets[level + 1] - layout.offsets[level] - 1)
    wx, wy, wz = (torch.stack([1 - f, f]) for f in fractions)
    weights = wx[:, None, None] * wy[:, None] * wz
    return entries.flatten(0, 2), weights.flatten(0, 2), fractions


def _both_ends(cell: Tensor, strides: tuple[int, ...]) -> tuple[Tensor, Tensor, Tensor]:
    """The cell's two ends along x, y, z times the axis's stride, shaped to broadcast to (2, 2, 2, N)."""
    signed = [(stride + 2**31) % 2**32 - 2**31 for stride in strides]
    x, y, z = (torch.stack([row * s, row * s + s]) for row, s in zip(cell, signed, strict=True))
    return x[:, None, None], y[:, None], z


def hash_grid_reference(positions: Tensor, table: Tensor, layout: HashGridLayout) -> Tensor:
    """The encoding as the paper writes it: the truth, in any float type, differentiable to any order.

    Args:
        positions: (N, 3) in [0, 1].
        table: (E, F) entries of all levels.
    Returns: (N, L * F), level by level.
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
    """A table's gradient that is not added up yet: what the backward passes of several encodings left.

    A step touches few entries. Adding them up level by level, with Adam at once on each, makes one pass over the
    table where autograd's dense gradient makes many.
    """

    def __init__(self, layout: HashGridLayout) -> None:
        self.layout = layout
        self.parts: Parts = []
        """Positions (N, 3) and incoming gradient (N, L * F) of each encoding."""

    @property
    def pending(self) -> bool:
        """Whether there is any."""
        return bool(self.parts)

    def clear(self) -> None:
        """Forget it."""
        self.parts.clear()

    def finite(self) -> bool:
        """Whether no incoming gradient is infinite or NaN."""
        return all(all_finite(grad) for _, grad in self.parts)

    def _arguments(self, features: int) -> tuple[Any, ...]:
        ends = tuple(accumulate(len(positions) for positions, _ in self.parts))
        positions = [native.pointer(x, "positions", (len(x), 3)) for x, _ in self.parts]
        width = self.layout.num_levels * features
        grads = [native.pointer(g, "the gradient", (len(x), width)) for x, g in self.parts]
        layout = (*self.layout.arrays, self.layout.num_levels)
        return native.pointers(positions), native.pointers(grads), native.integers(ends), len(ends), features, *layout

    def add_to(self, grad: Tensor) -> None:
        """Add it all to `grad` (E, F), and forget it."""
        shape = (self.layout.num_entries, grad.shape[1])
        into = native.pointer(grad, "the table's gradient", shape)
        _backward_table(*self._arguments(shape[1]), into, native.threads())
        self.parts.clear()

    def adam(
        self, table: Tensor, mean: Tensor, square: Tensor, seen: Tensor,
        rate: float, betas: tuple[float, float], eps: float,
    ) -> int:  # fmt: skip
        """One step of `framework.kernels.adam.sparse_adam` with this gradient, which is forgotten then."""
        shape = (self.layout.num_entries, table.shape[1])
        updated = _adam(
            *self._arguments(shape[1]), native.pointer(table, "the table", shape), native.pointer(mean, "mean", shape),
            native.pointer(square, "square", shape), native.pointer(seen, "seen", shape[:1]), rate, *betas, eps,
            native.threads(),
        )  # fmt: skip
        self.parts.clear()
        return updated


class _HashGrid(torch.autograd.Function):
    """The compiled encoding."""

    @staticmethod
    def forward(
        ctx: Any,
        positions: Tensor,
        table: Tensor,
        later: Tensor | None,
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
            alone = TableGradient(layout)
            alone.parts.append((positions, grad))
            alone.add_to(grad_table)
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
    """Multiresolution hash encoding.

    Args:
        positions: (N, 3) in [0, 1]; what lies outside is moved to the face.
        table: (E, F) entries of all levels, E = layout.num_entries.
        layout: resolutions and offsets.
        deferred: where a compiled backward pass that asks for the table's gradient leaves it, autograd getting none.
    Returns: (N, L * F) features in the table's type. First derivatives only; see `hash_grid_reference`.
    Raises: ValueError where a shape does not fit the layout.
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


@HASH_GRID.implementation(CPP, fits=lambda positions, table, *_: table.shape[1] in (1, 2, 4, 8))
def _compiled(positions: Tensor, table: Tensor, layout: HashGridLayout, deferred: TableGradient | None) -> Tensor:
    positions, table, later = positions.contiguous(), table.contiguous(), None
    if deferred is not None and table.requires_grad:
        later = waiting(table, positions, layout.num_levels * table.shape[1], deferred.parts)
        table = table.detach()
    return _HashGrid.apply(positions, table, later, layout)
