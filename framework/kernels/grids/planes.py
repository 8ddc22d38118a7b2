"""Factorised features: K-Planes (Fridovich-Keil et al. 2023), section 3; TensoRF (Chen et al. 2022), section 4.

A factor is a plane of features over two axes, or a line of features along one axis. Each factor of a group is
interpolated at the projection of a position, bilinearly or linearly, and the results are multiplied. The products of
all groups are concatenated. The groups of K-Planes are its scales, with a plane for every pair of axes (equation 2).
The VM decomposition of TensoRF has three groups of a plane and the line perpendicular to it, its CP decomposition one
group of three lines (equations 4 and 3).
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import torch
from torch import Tensor

from nerfloom.geometry.limits import between
from nerfloom.kernels import native, result_cache, table_memory
from nerfloom.kernels.adam.deferred import DeferredGradient, waiting
from nerfloom.kernels.dispatch import CPP, FEW_OPERATIONS, TRITON, Operation
from nerfloom.kernels.grids.plane_bands import Shape, add_variation_gradient
from nerfloom.kernels.grids.planes_layout import PlanesLayout
from nerfloom.kernels.triton_backend import later

MAX_HELD = 2**26
"""Maximum number of corner features held at once in the form with few operations; it processes positions in parts."""


def planes_reference(
    positions: Tensor, table: Tensor, layout: PlanesLayout, deferred: PlanesGradient | None = None
) -> Tensor:
    """Compute `planes` of `positions`, `table` and `layout` in PyTorch; `deferred` is not used."""
    clamped, features = between(positions, 0.0, 1.0), []
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


class PlanesGradient(DeferredGradient):
    """The deferred gradient of a table: positions (N, D) of look-ups, and gradients (N, G * F) of their results.

    A step uses few entries. The gradient is accumulated in a table kept between steps; Adam resets the used entries to
    zero.

    Args:
        layout: axes, resolutions and offsets of the factors in use: all of the table's, or the first ones.
    """

    def __init__(self, layout: PlanesLayout) -> None:
        super().__init__()
        self.layout = layout
        self.bands: list[tuple[int, Tensor]] = []
        """Index of the first entry, and gradient (B, F), of each band of entries read by `plane_bands`."""
        self.variations: list[tuple[tuple[Shape, ...], Tensor]] = []
        """Bands passed to `band_variation`, and gradient (K,) of its result."""
        self._sum: Tensor | None = None

    @property
    def gradients(self) -> list[Tensor]:
        return [grad for _, grad in (*self.parts, *self.bands, *self.variations)]

    @property
    def pending(self) -> bool:
        return bool(self.parts or self.bands or self.variations)

    def clear(self) -> None:
        super().clear()
        self.bands.clear()
        self.variations.clear()

    def relayout(self, layout: PlanesLayout) -> None:
        """Change the layout of the table to `layout` and discard the gradient."""
        self.clear()
        self.layout, self._sum = layout, None

    def summed(self, table: Tensor) -> Tensor:
        if self._sum is None:
            self._sum = table_memory.table(*table.shape)
        end = self.layout.num_entries
        for positions, grad in self.parts:
            _add_to(self._sum[:end], positions, table[:end], grad, self.layout)
        for first, grad in self.bands:
            self._sum[first : first + len(grad)] += grad
        for shapes, grad in self.variations:
            add_variation_gradient(self._sum, table, shapes, grad)
        self.clear()
        return self._sum


class _Planes(torch.autograd.Function):
    """The compiled form of `planes`."""

    @staticmethod
    def forward(ctx: Any, positions: Tensor, table: Tensor, placeholder: Tensor | None, layout: PlanesLayout) -> Tensor:
        def compute() -> Tensor:
            out = positions.new_empty(len(positions), layout.num_groups * table.shape[1])
            _forward(*_arguments(positions, table, layout), out.data_ptr(), native.threads())
            return out

        ctx.save_for_backward(positions, table)
        ctx.layout = layout
        return result_cache.result(("planes", layout), (positions,), (table,), compute)

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


def planes(positions: Tensor, table: Tensor, layout: PlanesLayout, deferred: PlanesGradient | None = None) -> Tensor:
    """Return the factorised features at positions: K-Planes, section 3, and TensoRF, section 4.

    The compiled form has first derivatives only.

    Args:
        positions: (N, D); coordinates are clamped to [0, 1].
        table: (E, F) entries of all factors, E = layout.num_entries.
        layout: axes, resolutions and offsets of the factors.
        deferred: collects the gradient of the table in the compiled form instead of autograd; None for autograd.

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


PLANES: Operation[..., Tensor] = Operation("planes", planes_reference)


@PLANES.implementation(CPP)
def _compiled(positions: Tensor, table: Tensor, layout: PlanesLayout, deferred: PlanesGradient | None) -> Tensor:
    positions, table, placeholder = positions.contiguous(), table.contiguous(), None
    if deferred is not None and table.requires_grad:
        placeholder = waiting(table, positions, layout.num_groups * table.shape[1], deferred.parts)
        table = table.detach()
    return _Planes.apply(positions, table, placeholder, layout)


PLANES.implementation(TRITON)(later("grids.planes_triton", "planes"))


class _Factors(NamedTuple):
    """Constants of all P factors on a device, shaped for operations with positions (2 P, N)."""

    axes: Tensor
    """(2 P,) int64 first axes of all factors, then their second axes; a line has its only axis twice."""
    cells: Tensor
    """(2 P, 1) number of cells along these axes."""
    planes: Tensor
    """(P, 1) 1 for planes and 0 for lines, which are constant along their second axis."""
    offsets: Tensor
    """(P, 1, 1, 1) int64 index of the first entry."""
    strides: Tensor
    """(P, 1, 1, 1) int64 entries from one row to the next; 0 for lines."""
    ends: Tensor
    """(2,) int64: 0 and 1."""


@lru_cache(maxsize=64)
def _factors(layout: PlanesLayout, dtype: torch.dtype, device: torch.device) -> _Factors:
    """Return the constants; cached, because a copy to the device waits for it."""
    factors = [(sizes, along) for sizes, group in zip(layout.resolutions, layout.axes, strict=True) for along in group]
    pairs = [(along[0], along[-1]) for _, along in factors]
    axes = [first for first, _ in pairs] + [second for _, second in pairs]
    cells = [sizes[axis] - 1 for (sizes, _), axis in zip(factors * 2, axes, strict=True)]
    strides = [sizes[along[0]] if len(along) == 2 else 0 for sizes, along in factors]
    offsets = [first for firsts in layout.offsets for first in firsts]

    def column(values: list[Any], kind: torch.dtype, dims: int) -> Tensor:
        return torch.tensor(values, dtype=kind, device=device).view(-1, *[1] * dims)

    return _Factors(
        column(axes, torch.int64, 0), column(cells, dtype, 1), column([min(stride, 1) for stride in strides], dtype, 1),
        column(offsets, torch.int64, 3), column(strides, torch.int64, 3), column([0, 1], torch.int64, 0),
    )  # fmt: skip


@PLANES.implementation(FEW_OPERATIONS, types=None, order=torch.inf)
def _all_factors(positions: Tensor, table: Tensor, layout: PlanesLayout, deferred: PlanesGradient | None) -> Tensor:
    """Compute `planes` with one set of operations for all factors, for any device and float type."""
    held = 4 * layout.num_groups * len(layout.axes[0]) * table.shape[1]
    found = [_at_all_factors(part, table, layout) for part in positions.split(max(MAX_HELD // held, 1))]
    return found[0] if len(found) == 1 else torch.cat(found)


def _at_all_factors(positions: Tensor, table: Tensor, layout: PlanesLayout) -> Tensor:
    constants = _factors(layout, positions.dtype, positions.device)
    scaled = between(positions.t(), 0.0, 1.0).index_select(0, constants.axes) * constants.cells  # (2 P, N)
    cell = torch.minimum(scaled.detach().nan_to_num().floor(), constants.cells - 1)
    first, second = (scaled - cell).chunk(2)
    across, up = cell.long()[:, None].chunk(2)  # (P, 1, N)
    ends = constants.ends
    rows = (up + ends[:, None])[:, :, None] * constants.strides  # (P, 2, 1, N)
    entries = rows + (across + ends[:, None])[:, None] + constants.offsets  # (P, 2, 2, N)
    second = second * constants.planes
    along, beside = (torch.stack([1 - fraction, fraction], 1) for fraction in (first, second))
    weights = beside[:, :, None] * along[:, None]
    # index_select adds its gradient in place; on a GPU the gradient of table[entries] would be sorted first.
    corners = table.index_select(0, entries.flatten()).view(len(constants.offsets), 4, len(positions), table.shape[1])
    values = (corners * weights.flatten(1, 2)[..., None]).sum(1).unflatten(0, (layout.num_groups, -1))
    product, *others = values.unbind(1)
    for other in others:
        product = product * other
    return product.transpose(0, 1).flatten(1)
