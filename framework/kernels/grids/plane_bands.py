"""Bands of rows of factors, and their variation, for regularisers of large tables.

Reading all of a table in every step would take a regulariser longer than the step itself. The mean over a band of rows
at a random position is an unbiased estimate.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from nerfloom.kernels import native
from nerfloom.kernels.dispatch import CPP, FEW_OPERATIONS, Operation
from nerfloom.kernels.grids.planes_layout import PlanesLayout

if TYPE_CHECKING:
    from nerfloom.kernels.grids.planes import PlanesGradient

Band = tuple[int, int, int, int]
"""Group, factor in the group, first row, and number of rows."""
Shape = tuple[int, int, int]
"""Index of the first entry of a band, number of rows, and number of entries of a row."""


class _Band(torch.autograd.Function):
    """Rows of a table, with a deferred gradient; the table is the only input with a gradient."""

    @staticmethod
    def forward(ctx: Any, table: Tensor, shape: Shape, deferred: PlanesGradient) -> Tensor:
        ctx.first, ctx.deferred = shape[0], deferred
        return _entries(table, shape).clone()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[None, None, None]:
        ctx.deferred.bands.append((ctx.first, grad.flatten(0, 1)))
        return None, None, None


class _Bands(torch.autograd.Function):
    """Rows of a table, for several bands, with one gradient of the table for all of them."""

    @staticmethod
    def forward(ctx: Any, table: Tensor, shapes: tuple[Shape, ...]) -> tuple[Tensor, ...]:
        ctx.shapes, ctx.shape = shapes, table.shape
        ctx.set_materialize_grads(False)
        return tuple(_entries(table, shape).clone() for shape in shapes)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, None]:
        known = [(shape, grad) for shape, grad in zip(ctx.shapes, grads, strict=True) if grad is not None]
        if not known:
            return None, None
        total = known[0][1].new_zeros(ctx.shape)
        for shape, grad in known:
            _entries(total, shape).add_(grad)
        return total, None


def _entries(table: Tensor, shape: Shape) -> Tensor:
    """Return the rows of a band, (rows, entries of a row, F), which share the table's memory."""
    first, rows, across = shape
    return table[first : first + rows * across].view(rows, across, table.shape[1])


def _bands_reference(table: Tensor, shapes: tuple[Shape, ...], deferred: PlanesGradient | None) -> list[Tensor]:
    return [_entries(table, shape) for shape in shapes]


PLANE_BANDS = Operation("plane_bands", _bands_reference)


@PLANE_BANDS.implementation(CPP, fits=lambda table, shapes, deferred: deferred is not None)
def _bands_deferred(table: Tensor, shapes: tuple[Shape, ...], deferred: PlanesGradient | None) -> list[Tensor]:
    return [_Band.apply(table, shape, deferred) for shape in shapes]


@PLANE_BANDS.implementation(FEW_OPERATIONS, types=None)
def _bands_at_once(table: Tensor, shapes: tuple[Shape, ...], deferred: PlanesGradient | None) -> list[Tensor]:
    return list(_Bands.apply(table, shapes))


def plane_bands(
    table: Tensor, layout: PlanesLayout, bands: Sequence[Band], deferred: PlanesGradient | None = None
) -> list[Tensor]:
    """Return consecutive rows of factors.

    Args:
        table: (E, F) entries of all factors.
        layout: axes, resolutions and offsets of the factors.
        bands: group, factor in the group, first row and number of rows of each band; rows are along the second axis.
        deferred: collects the gradient of the table on the CPU instead of autograd, as in `planes`; None for autograd.

    Returns:
        (rows, vertices along the first axis, F) entries of each band.
    """
    return PLANE_BANDS((table,), table, _shapes(layout, bands), deferred)


def _shapes(layout: PlanesLayout, bands: Sequence[Band]) -> tuple[Shape, ...]:
    found = []
    for group, index, first_row, rows in bands:
        _, across = layout.shape(group, index)
        found.append((layout.offsets[group][index] + first_row * across, rows, across))
    return tuple(found)


def squared_steps(band: Tensor, dim: int) -> Tensor:
    """Return the mean squared difference () of neighbours along an axis; 0 for a single entry.

    Args:
        band: values of a factor, or of some of its rows.
        dim: the axis.
    """
    return band.diff(dim=dim).square().mean() if band.shape[dim] > 1 else band.new_zeros(())


def variation(bands: Sequence[Tensor]) -> Tensor:
    """Return the total variation (K,) of K bands: the sum over both axes of the mean squared difference of neighbours.

    Args:
        bands: (rows, vertices along the first axis, F) entries of each band.
    """
    return torch.stack([squared_steps(band, 0) + squared_steps(band, 1) for band in bands])


_forward = native.Function("band_variation", "piippi")
_backward = native.Function("band_variation_backward", "piipppi")


class _Variation(torch.autograd.Function):
    """The compiled form of `band_variation`, with a deferred gradient: no difference is ever written to memory."""

    @staticmethod
    def forward(ctx: Any, table: Tensor, shapes: tuple[Shape, ...], deferred: PlanesGradient) -> Tensor:
        ctx.shapes, ctx.deferred = shapes, deferred
        found = table.new_empty(len(shapes))
        _forward(*_arguments(table, shapes), found.data_ptr(), native.threads())
        return found

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[None, None, None]:
        ctx.deferred.variations.append((ctx.shapes, grad.contiguous()))
        return None, None, None


def _arguments(table: Tensor, shapes: tuple[Shape, ...]) -> tuple[Any, ...]:
    entries = native.pointer(table, "the planes", tuple(table.shape))
    return entries, table.shape[1], len(shapes), native.integers(tuple(number for shape in shapes for number in shape))


def add_variation_gradient(total: Tensor, table: Tensor, shapes: tuple[Shape, ...], grad: Tensor) -> None:
    """Add the gradient of `band_variation` to a table of gradients.

    Args:
        total: (E, F) gradients of all entries; the result is added to it.
        table: (E, F) entries.
        shapes: the K bands.
        grad: (K,) gradients of their variation.
    """
    into = native.pointer(total, "the planes' gradient", tuple(table.shape))
    incoming = native.pointer(grad, "the gradient", (len(shapes),))
    _backward(*_arguments(table, shapes), incoming, into, native.threads())


def _variation_reference(table: Tensor, shapes: tuple[Shape, ...], deferred: PlanesGradient | None) -> Tensor:
    return variation(PLANE_BANDS((table,), table, shapes, deferred))


BAND_VARIATION = Operation("band_variation", _variation_reference)


@BAND_VARIATION.implementation(CPP, fits=lambda table, shapes, deferred: deferred is not None)
def _compiled(table: Tensor, shapes: tuple[Shape, ...], deferred: PlanesGradient | None) -> Tensor:
    return _Variation.apply(table, shapes, deferred)


def band_variation(
    table: Tensor, layout: PlanesLayout, bands: Sequence[Band], deferred: PlanesGradient | None = None
) -> Tensor:
    """Return the total variation (K,) of consecutive rows of K factors, as `variation` of `plane_bands`.

    The compiled form has first derivatives only. `table`, `layout`, `bands` and `deferred` are as in `plane_bands`.
    """
    return BAND_VARIATION((table,), table, _shapes(layout, bands), deferred)
