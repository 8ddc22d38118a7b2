"""Factorised features: K-Planes (Fridovich-Keil et al. 2023), section 3; TensoRF (Chen et al. 2022), section 4.

A factor is a plane of features over two axes, or a line of features along one axis. Each factor of a group is
interpolated at the projection of a position, bilinearly or linearly, and the results are multiplied. The products of
all groups are concatenated. The groups of K-Planes are its scales, with a plane for every pair of axes (equation 2).
The VM decomposition of TensoRF has three groups of a plane and the line perpendicular to it, its CP decomposition one
group of three lines (equations 4 and 3).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import Any

import torch
from torch import Tensor

from framework.base.errors import ConfigError, shown
from framework.kernels import kept, memory, native
from framework.kernels.adam import all_finite, sparse_adam
from framework.kernels.deferred import Parts, waiting
from framework.kernels.dispatch import CPP, TRITON, Operation
from framework.kernels.triton_kernels import later

MAX_GROUPS, MAX_FACTORS = 64, 6
"""Maximum number of groups, and of factors of a group."""
MAX_VERTICES = 2**20
"""Maximum number of vertices along an axis; float32 then has 4 bits left for the position between two vertices."""


@dataclass(frozen=True)
class PlanesLayout:
    """Axes, resolution and entries of each factor, in one table (E, F) that all factors share.

    Raises:
        ConfigError: if the numbers are inconsistent or out of range; the kernels rely on them.
    """

    resolutions: tuple[tuple[int, ...], ...]
    """Vertices along each of the D axes, for each of the G groups."""
    axes: tuple[tuple[tuple[int, ...], ...], ...]
    """The axis or two axes of each factor, per group. The index along the first axis varies fastest."""
    offsets: tuple[tuple[int, ...], ...]
    """Index of the first entry of each factor, per group."""
    num_entries: int
    """Number E of entries of all factors."""

    def __post_init__(self) -> None:
        _check_factors(self.resolutions, self.axes)
        for sizes, group, firsts in zip(self.resolutions, self.axes, self.offsets, strict=True):
            for along, first in zip(group, firsts, strict=True):
                last = first + math.prod(sizes[axis] for axis in along)
                if not 0 <= first < last <= self.num_entries:
                    raise ConfigError(f"planes of {self.num_entries} entries have no entries {first} to {last}")

    @classmethod
    def build(
        cls, resolutions: tuple[tuple[int, ...], ...], axes: tuple[tuple[tuple[int, ...], ...], ...] | None = None
    ) -> PlanesLayout:
        """Return the layout of factors, one after the other in the table.

        Args:
            resolutions: vertices along each of the D axes, for each of the G groups.
            axes: the axis or two axes of each factor, per group; a plane for every pair of axes if None.

        Raises:
            ConfigError: if an axis has less than 2 or more than MAX_VERTICES vertices, or the groups differ in their
                number of axes or factors.
        """
        axes = axes or tuple(tuple(combinations(range(len(scale)), 2)) for scale in resolutions)
        _check_factors(resolutions, axes)
        offsets, total = [], 0
        for sizes, group in zip(resolutions, axes, strict=True):
            firsts = []
            for along in group:
                firsts.append(total)
                total += math.prod(sizes[axis] for axis in along)
            offsets.append(tuple(firsts))
        return cls(resolutions, axes, tuple(offsets), total)

    @property
    def dims(self) -> int:
        """Number D of axes."""
        return len(self.resolutions[0])

    @property
    def num_groups(self) -> int:
        """Number G of groups."""
        return len(self.resolutions)

    def shape(self, group: int, index: int) -> tuple[int, int]:
        """Return the vertices along the second axis, 1 for a line, and the first axis of factor `index` of `group`."""
        sizes = [self.resolutions[group][axis] for axis in self.axes[group][index]]
        return (sizes[1] if len(sizes) == 2 else 1), sizes[0]

    def factor(self, table: Tensor, group: int, index: int) -> Tensor:
        """Return a view of a factor's entries.

        Args:
            table: (E, F) entries of all factors.
            group: number of the group.
            index: number of the factor in the group.

        Returns:
            (vertices along the second axis, or 1, vertices along the first axis, F) entries.
        """
        up, across = self.shape(group, index)
        first = self.offsets[group][index]
        return table[first : first + across * up].view(up, across, -1)

    @cached_property
    def arrays(self) -> tuple[Any, Any, Any]:
        """Axes, resolutions and offsets as C arrays."""
        axes = tuple(axis for group in self.axes for along in group for axis in (*along, -1)[:2])
        flat = (tuple(value for row in rows for value in row) for rows in (self.resolutions, self.offsets))
        resolutions, offsets = (native.integers(values) for values in flat)
        return native.integers(axes), resolutions, offsets


def _check_factors(resolutions: tuple[tuple[int, ...], ...], axes: tuple[tuple[tuple[int, ...], ...], ...]) -> None:
    """Check vertices and axes, on which the kernels rely; a ConfigError says what is wrong."""
    dims = {len(scale) for scale in resolutions}
    if len(dims) != 1 or not dims <= {2, 3, 4} or len(resolutions) > MAX_GROUPS:
        groups = f"{len(resolutions)} groups of {sorted(dims)} axes"
        raise ConfigError(f"planes need 1 to {MAX_GROUPS} groups of the same 2 to 4 axes, not {groups}")
    for size in (size for scale in resolutions for size in scale):
        if not isinstance(size, int) or not 2 <= size <= MAX_VERTICES:
            raise ConfigError(f"planes need 2 to {MAX_VERTICES} vertices along each axis, not {shown(size)}")
    (count,) = dims
    numbers = {len(group) for group in axes}
    if len(axes) != len(resolutions) or len(numbers) != 1 or not numbers <= set(range(1, MAX_FACTORS + 1)):
        raise ConfigError(f"planes need 1 to {MAX_FACTORS} factors, as many in every group, not {shown(axes)}")
    for along in (along for group in axes for along in group):
        if len(along) not in (1, 2) or len(set(along)) != len(along) or not set(along) <= set(range(count)):
            raise ConfigError(f"planes need one or two of the axes 0 to {count - 1} for each factor, not {along}")


def planes_reference(positions: Tensor, table: Tensor, layout: PlanesLayout) -> Tensor:
    """Compute `planes` in PyTorch, on any device and for any float type, with derivatives of any order.

    Args:
        positions: (N, D); coordinates are clamped to [0, 1].
        table: (E, F) entries of all factors.
        layout: axes, resolutions and offsets of the factors.

    Returns:
        (N, G * F) features, group by group.
    """
    clamped, features = positions.clamp(0, 1), []
    for group, resolution in enumerate(layout.resolutions):
        vertices = torch.tensor(resolution, device=positions.device)
        scaled = clamped * (vertices - 1).to(positions)
        cell = torch.minimum(scaled.detach().nan_to_num().long(), vertices - 2)
        fraction = scaled - cell
        product: Tensor | None = None
        for index, (a, *b) in enumerate(layout.axes[group]):
            first = layout.offsets[group][index] + cell[:, a]
            fa = fraction[:, a, None]
            if b:
                across, fb = resolution[a], fraction[:, b[0], None]
                first = first + cell[:, b[0]] * across
                low = table[first] * (1 - fa) + table[first + 1] * fa
                high = table[first + across] * (1 - fa) + table[first + across + 1] * fa
                value = low * (1 - fb) + high * fb
            else:
                value = table[first] * (1 - fa) + table[first + 1] * fa
            product = value if product is None else product * value
        assert product is not None
        features.append(product)
    return torch.cat(features, dim=-1)


_TAIL = "iiiippp"
_forward = native.Function("planes_forward", "pqp" + _TAIL + "pi")
_backward_table = native.Function("planes_backward_table", "pqp" + _TAIL + "ppi")
_backward_positions = native.Function("planes_backward_positions", "pqp" + _TAIL + "ppi")


class PlanesGradient:
    """The deferred gradient of a table: gradients of look-ups, collected in backward passes and not yet accumulated.

    A step uses few entries. The gradient is accumulated in a table that is kept between steps, in which Adam sets the
    entries that were used to zero.

    Args:
        layout: axes, resolutions and offsets of the factors.
    """

    def __init__(self, layout: PlanesLayout) -> None:
        self.layout = layout
        self.parts: Parts = []
        """Positions (N, D) of each look-up, and gradient (N, G * F) of its result."""
        self.bands: list[tuple[int, Tensor]] = []
        """Index of the first entry, and gradient (B, F), of each band of entries that `plane_band` has read."""
        self._sum: Tensor | None = None

    def finite(self) -> bool:
        """Return whether no value of the collected gradients is infinite or NaN."""
        return all(all_finite(grad) for _, grad in (*self.parts, *self.bands))

    @property
    def pending(self) -> bool:
        """True if there is a gradient."""
        return bool(self.parts or self.bands)

    def clear(self) -> None:
        """Discard the gradient."""
        self.parts.clear()
        self.bands.clear()

    def relayout(self, layout: PlanesLayout) -> None:
        """Change the layout of the table to `layout`, and discard the gradient."""
        self.clear()
        self.layout, self._sum = layout, None

    def adam(
        self, table: Tensor, mean: Tensor, square: Tensor, seen: Tensor,
        rate: float, betas: tuple[float, float], eps: float,
    ) -> int | Tensor:  # fmt: skip
        """Update `table` (E, F) by `framework.kernels.adam.sparse_adam` with this gradient, and discard the gradient.

        `mean`, `square`, `seen`, `rate`, `betas`, `eps` and the result are as in `sparse_adam`.
        """
        return sparse_adam(table, self.summed(table), mean, square, seen, rate, betas, eps)

    def summed(self, table: Tensor) -> Tensor:
        """Return the accumulated gradient (E, F) of `table`, and discard it.

        The result's memory is used again: its entries must be zero before the next call, as Adam leaves them.
        """
        if self._sum is None:
            self._sum = memory.table(*table.shape)
        for positions, grad in self.parts:
            _add_to(self._sum, positions, table, grad, self.layout)
        for first, grad in self.bands:
            self._sum[first : first + len(grad)] += grad
        self.clear()
        return self._sum


class _Planes(torch.autograd.Function):
    """The compiled form of `planes`."""

    @staticmethod
    def forward(
        ctx: Any,
        positions: Tensor,
        table: Tensor,
        placeholder: Tensor | None,
        layout: PlanesLayout,
    ) -> Tensor:
        def compute() -> Tensor:
            out = positions.new_empty(len(positions), layout.num_groups * table.shape[1])
            _forward(*_arguments(positions, table, layout), out.data_ptr(), native.threads())
            return out

        ctx.save_for_backward(positions, table)
        ctx.layout = layout
        return kept.result(("planes", layout), (positions,), (table,), compute)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        positions, table = ctx.saved_tensors
        grad = grad.contiguous()
        grad_positions = grad_table = None
        if ctx.needs_input_grad[0]:
            grad_positions = torch.empty_like(positions)
            incoming = _incoming(grad, positions, table, ctx.layout)
            arguments = _arguments(positions, table, ctx.layout)
            _backward_positions(*arguments, incoming, grad_positions.data_ptr(), native.threads())
        if ctx.needs_input_grad[1]:
            grad_table = torch.zeros_like(table)
            _add_to(grad_table, positions, table, grad, ctx.layout)
        return grad_positions, grad_table, grad if ctx.needs_input_grad[2] else None, None


def _add_to(total: Tensor, positions: Tensor, table: Tensor, grad: Tensor, layout: PlanesLayout) -> None:
    into = native.pointer(total, "the planes' gradient", tuple(table.shape))
    incoming = _incoming(grad, positions, table, layout)
    _backward_table(*_arguments(positions, table, layout), incoming, into, native.threads())


def _incoming(grad: Tensor, positions: Tensor, table: Tensor, layout: PlanesLayout) -> int:
    return native.pointer(grad, "the gradient", (len(positions), layout.num_groups * table.shape[1]))


def _arguments(positions: Tensor, table: Tensor, layout: PlanesLayout) -> tuple[Any, ...]:
    count, features = len(positions), table.shape[1]
    points = native.pointer(positions, "positions", (count, layout.dims))
    entries = native.pointer(table, "the planes", (layout.num_entries, features))
    sizes = layout.dims, features, layout.num_groups, len(layout.axes[0])
    return points, count, entries, *sizes, *layout.arrays


class _Band(torch.autograd.Function):
    """Rows [first, end) of a table, whose gradient is deferred; the table is the only input with a gradient."""

    @staticmethod
    def forward(ctx: Any, table: Tensor, first: int, end: int, deferred: PlanesGradient) -> Tensor:
        ctx.first, ctx.deferred = first, deferred
        return table[first:end].clone()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[None, None, None, None]:
        ctx.deferred.bands.append((ctx.first, grad))
        return None, None, None, None


def _band_reference(table: Tensor, first: int, end: int, deferred: PlanesGradient | None) -> Tensor:
    return table[first:end]


PLANE_BAND = Operation("plane_band", _band_reference)


@PLANE_BAND.implementation(CPP, fits=lambda table, first, end, deferred: deferred is not None)
def _band_deferred(table: Tensor, first: int, end: int, deferred: PlanesGradient | None) -> Tensor:
    return _Band.apply(table, first, end, deferred)


def plane_band(
    table: Tensor, layout: PlanesLayout, group: int, index: int, first_row: int, rows: int,
    deferred: PlanesGradient | None = None,
) -> Tensor:  # fmt: skip
    """Return consecutive rows of a factor, for regularisers, for which reading all of a large table is slow.

    Args:
        table: (E, F) entries of all factors.
        layout: axes, resolutions and offsets of the factors.
        group: number of the group.
        index: number of the factor in the group.
        first_row: index of the first row, along the factor's second axis.
        rows: number of rows.
        deferred: collects the gradient of the table on the CPU, instead of autograd, as in `planes`; None for autograd.

    Returns:
        (rows, vertices along the first axis, F) entries.
    """
    _, across = layout.shape(group, index)
    first = layout.offsets[group][index] + first_row * across
    return PLANE_BAND((table,), table, first, first + rows * across, deferred).view(rows, across, -1)


def planes(
    positions: Tensor,
    table: Tensor,
    layout: PlanesLayout,
    deferred: PlanesGradient | None = None,
) -> Tensor:
    """Return the factorised features at positions: K-Planes, section 3, and TensoRF, section 4.

    The compiled form has first derivatives only.

    Args:
        positions: (N, D); coordinates are clamped to [0, 1].
        table: (E, F) entries of all factors, E = layout.num_entries.
        layout: axes, resolutions and offsets of the factors.
        deferred: collects the gradient of the table in the compiled form, instead of autograd; None for autograd.

    Returns:
        (N, G * F) features, group by group.

    Raises:
        ValueError: if a shape does not fit the layout.
    """
    if positions.ndim != 2 or positions.shape[1] != layout.dims:
        raise ValueError(f"planes: positions have shape {tuple(positions.shape)}, not (N, {layout.dims})")
    if table.ndim != 2 or table.shape[0] != layout.num_entries:
        raise ValueError(f"planes: the table has shape {tuple(table.shape)}, not ({layout.num_entries}, F)")
    positions = positions.to(table.dtype)
    return PLANES((positions, table), positions, table, layout, deferred)


def _reference(positions: Tensor, table: Tensor, layout: PlanesLayout, deferred: PlanesGradient | None) -> Tensor:
    return planes_reference(positions, table, layout)


PLANES = Operation("planes", _reference)


@PLANES.implementation(CPP)
def _compiled(positions: Tensor, table: Tensor, layout: PlanesLayout, deferred: PlanesGradient | None) -> Tensor:
    positions, table, placeholder = positions.contiguous(), table.contiguous(), None
    if deferred is not None and table.requires_grad:
        placeholder = waiting(table, positions, layout.num_groups * table.shape[1], deferred.parts)
        table = table.detach()
    return _Planes.apply(positions, table, placeholder, layout)


PLANES.implementation(TRITON)(later("planes", "planes"))
