"""Factorised features: K-Planes (Fridovich-Keil et al. 2023), section 3; TensoRF (Chen et al. 2022), section 4.

A group of factors, each a plane over two axes or a line along one, is looked up where a position falls on each, by
bilinear or linear interpolation, and the features found are multiplied. Groups stand side by side. K-Planes' groups
are its scales, with a plane for every pair of axes (equation 2). TensoRF's VM decomposition has three groups of a plane
and the line across it, its CP decomposition one group of three lines (equations 4 and 3).
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
from framework.kernels.dispatch import CPP, Operation

MAX_GROUPS, MAX_FACTORS = 64, 6
MAX_VERTICES = 2**20
"""Along an axis: float32 has 4 bits left for where between such vertices a position lies."""


@dataclass(frozen=True)
class PlanesLayout:
    """Where each plane's entries stand in the one table (E, F) that all share.

    Raises: ConfigError where axes, vertices or entries are none that factors can have: the kernels rely on it.
    """

    resolutions: tuple[tuple[int, ...], ...]
    """Vertices along each of D axes, per group."""
    axes: tuple[tuple[tuple[int, ...], ...], ...]
    """The axis or the two axes of each factor, per group. The first one's index runs fastest."""
    offsets: tuple[tuple[int, ...], ...]
    """First entry of each factor, per group."""
    num_entries: int

    def __post_init__(self) -> None:
        _check_factors(self.resolutions, self.axes)
        for sizes, group, firsts in zip(self.resolutions, self.axes, self.offsets, strict=True):
            for along, first in zip(group, firsts, strict=True):
                last = first + math.prod(sizes[axis] for axis in along)
                if not 0 <= first < last <= self.num_entries:
                    raise ConfigError(f"planes of {self.num_entries} entries have none from {first} to {last}")

    @classmethod
    def build(
        cls, resolutions: tuple[tuple[int, ...], ...], axes: tuple[tuple[tuple[int, ...], ...], ...] | None = None
    ) -> PlanesLayout:
        """Factors along the given axes; a plane for every pair of axes in every group if not given.

        Raises: ConfigError where an axis has fewer than 2 or more than MAX_VERTICES vertices, or the groups differ in
            how many axes or factors they have.
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
        """D, the number of axes."""
        return len(self.resolutions[0])

    @property
    def num_groups(self) -> int:
        return len(self.resolutions)

    def shape(self, group: int, index: int) -> tuple[int, int]:
        """Vertices of a factor along its second axis (1 for a line), and along its first."""
        sizes = [self.resolutions[group][axis] for axis in self.axes[group][index]]
        return (sizes[1] if len(sizes) == 2 else 1), sizes[0]

    def factor(self, table: Tensor, group: int, index: int) -> Tensor:
        """A factor of a table (E, F) as a view (vertices along the second axis or 1, along the first, F)."""
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
    """Refuse vertices and axes that the kernels cannot bear. Raises: ConfigError."""
    dims = {len(scale) for scale in resolutions}
    if len(dims) != 1 or not dims <= {2, 3, 4} or len(resolutions) > MAX_GROUPS:
        raise ConfigError(f"planes need the same 2 to 4 axes at every scale, of 1 to {MAX_GROUPS}, not {sorted(dims)}")
    for size in (size for scale in resolutions for size in scale):
        if not isinstance(size, int) or not 2 <= size <= MAX_VERTICES:
            raise ConfigError(f"planes need 2 to {MAX_VERTICES} vertices along each axis, not {shown(size)}")
    (count,) = dims
    numbers = {len(group) for group in axes}
    if len(axes) != len(resolutions) or len(numbers) != 1 or not numbers <= set(range(1, MAX_FACTORS + 1)):
        raise ConfigError(f"planes need as many factors in every group, 1 to {MAX_FACTORS}, not {shown(axes)}")
    for along in (along for group in axes for along in group):
        if len(along) not in (1, 2) or len(set(along)) != len(along) or not set(along) <= set(range(count)):
            raise ConfigError(f"planes need one or two of the axes 0 to {count - 1} for each factor, not {along}")


def planes_reference(positions: Tensor, table: Tensor, layout: PlanesLayout) -> Tensor:
    """The look-up as the paper writes it: the truth, in any float type, differentiable to any order."""
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
    """A table's gradient that is not added up yet: what the backward passes of several look-ups left.

    A step touches few entries. They are added up in a table that is kept, and that Adam clears where it was used.
    """

    def __init__(self, layout: PlanesLayout) -> None:
        self.layout = layout
        self.parts: Parts = []
        """Positions (N, D) and incoming gradient (N, G * F) of each look-up."""
        self.bands: list[tuple[int, Tensor]] = []
        """First entry and gradient (B, F) of each band of entries that was read as it is."""
        self._sum: Tensor | None = None

    def finite(self) -> bool:
        """Whether no incoming gradient is infinite or NaN."""
        return all(all_finite(grad) for _, grad in (*self.parts, *self.bands))

    @property
    def pending(self) -> bool:
        """Whether there is any."""
        return bool(self.parts or self.bands)

    def clear(self) -> None:
        """Forget it."""
        self.parts.clear()
        self.bands.clear()

    def relayout(self, layout: PlanesLayout) -> None:
        """The entries are others from now on, and what waits is void."""
        self.clear()
        self.layout, self._sum = layout, None

    def adam(
        self, table: Tensor, mean: Tensor, square: Tensor, seen: Tensor,
        rate: float, betas: tuple[float, float], eps: float,
    ) -> int:  # fmt: skip
        """One step of `framework.kernels.adam.sparse_adam` with this gradient, which is forgotten then."""
        if self._sum is None:
            self._sum = memory.table(*table.shape)
        for positions, grad in self.parts:
            _add_to(self._sum, positions, table, grad, self.layout)
        for first, grad in self.bands:
            self._sum[first : first + len(grad)] += grad
        self.clear()
        return sparse_adam(table, self._sum, mean, square, seen, rate, betas, eps)


class _Planes(torch.autograd.Function):
    """The compiled look-up."""

    @staticmethod
    def forward(
        ctx: Any,
        positions: Tensor,
        table: Tensor,
        later: Tensor | None,
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
        of_positions = of_table = None
        if ctx.needs_input_grad[0]:
            of_positions = torch.empty_like(positions)
            incoming = _incoming(grad, positions, table, ctx.layout)
            arguments = _arguments(positions, table, ctx.layout)
            _backward_positions(*arguments, incoming, of_positions.data_ptr(), native.threads())
        if ctx.needs_input_grad[1]:
            of_table = torch.zeros_like(table)
            _add_to(of_table, positions, table, grad, ctx.layout)
        return of_positions, of_table, grad if ctx.needs_input_grad[2] else None, None


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
    """Rows [first, end) of a table, whose gradient waits. Called back only for the table, its one input."""

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
    """Some rows of a plane, for regularisers that look at neighbours: a look at all of a large table is dear.

    Args:
        table: (E, F).
        group, index: which plane.
        first_row, rows: along the plane's second axis.
        deferred: where the gradient is left on the processor, as for `planes`.
    Returns: (rows, vertices along the first axis, F).
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
    """Factorised features.

    Args:
        positions: (N, D) in [0, 1]; what lies outside is moved to the edge.
        table: (E, F) entries of all planes, E = layout.num_entries.
        layout: resolutions and offsets.
        deferred: where a compiled backward pass that asks for the table's gradient leaves it, autograd getting none.
    Returns: (N, G * F), group by group. First derivatives only where compiled; see `planes_reference`.
    Raises: ValueError where a shape does not fit the layout.
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
    positions, table, later = positions.contiguous(), table.contiguous(), None
    if deferred is not None and table.requires_grad:
        later = waiting(table, positions, layout.num_groups * table.shape[1], deferred.parts)
        table = table.detach()
    return _Planes.apply(positions, table, later, layout)
