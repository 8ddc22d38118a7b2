"""Samples of a first shape plus a network, in Triton. `samples.py` has the reference."""

# mypy: allow-untyped-defs, allow-untyped-decorators, allow-incomplete-defs
# Triton gives the kernels' arguments their types.

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from nerfloom.kernels.surfaces.samples import PLACED, SHORTEST, FirstShape, Intervals
from nerfloom.kernels.triton_launch import blocks, launch, load_three, on_device, opacity_of, own_rows, store_three

BLOCK = 128
"""Samples per program."""


@triton.jit
def _distance(network, positions, centre, size, radius, rounding, floor, n, here, stride):
    """Return the offsets from the ball's centre, their lengths, whether the floor is nearer, and the distance."""
    x, y, z = load_three(positions + n * 3, here)
    height = x * tl.load(floor) + y * tl.load(floor + 1) + z * tl.load(floor + 2) - tl.load(floor + 3)
    x, y, z = x - tl.load(centre), y - tl.load(centre + 1), z - tl.load(centre + 2)
    far = tl.sqrt(x * x + y * y + z * z + rounding * rounding)
    lower = height < far - radius
    distance = tl.where(lower, height, far - radius) + size * tl.load(network + n * stride, mask=here, other=0.0)
    return x, y, z, far, lower, distance


@triton.jit
def _gradient(network, x, y, z, far, lower, scale, size, floor, n, here, stride):
    """Return the gradient of the distance."""
    along_x, along_y, along_z = load_three(network + n * stride + stride - 3, here)
    along_x = tl.where(lower, tl.load(floor), x / far) + size * tl.load(scale) * along_x
    along_y = tl.where(lower, tl.load(floor + 1), y / far) + size * tl.load(scale + 1) * along_y
    along_z = tl.where(lower, tl.load(floor + 2), z / far) + size * tl.load(scale + 2) * along_z
    return along_x, along_y, along_z


@triton.jit
def _logistic(x):
    """Return the logistic function of -x and of x."""
    small = tl.exp(-tl.abs(x))
    whole = 1 / (1 + small)
    rest = small * whole
    return tl.where(x < 0, whole, rest), tl.where(x < 0, rest, whole)


@triton.jit
def _half(cosine, length, annealing):
    """Return half of the fall of the distance within intervals."""
    wrong = 0.5 - 0.5 * cosine
    falling = tl.where(cosine < 0, -cosine, 0.0) * annealing + tl.where(wrong > 0, wrong, 0.0) * (1 - annealing)
    return falling * length * 0.5


@triton.jit(do_not_specialize=["count"])
def _forward(
    network, positions, directions, lengths, sharpness, annealing, centre, scale, size, radius, rounding, floor,
    stopping, features, count, D: tl.constexpr, INTERVALS: tl.constexpr, WIDTH: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    n, here = own_rows(count, BLOCK)
    s, annealing = tl.load(sharpness), tl.load(annealing)
    x, y, z, far, lower, distance = _distance(network, positions, centre, size, radius, rounding, floor, n, here, D + 3)
    along_x, along_y, along_z = _gradient(network, x, y, z, far, lower, scale, size, floor, n, here, D + 3)
    if INTERVALS:
        to_x, to_y, to_z = load_three(directions + n * 3, here)
        cosine = along_x * to_x + along_y * to_y + along_z * to_z
        half = _half(cosine, tl.load(lengths + n, mask=here, other=0.0), annealing)
        inside, _ = _logistic(s * (distance - half))
        value = inside * opacity_of(2 * s * half)
    else:
        outside = 0.5 * tl.exp(-s * tl.abs(distance))
        value = s * tl.where(distance > 0, outside, 1 - outside)
    tl.store(stopping + n, value, mask=here)
    to = features + n * (5 + D)
    store_three(to, along_x, along_y, along_z, here)
    store_three(to + 3, x / size, y / size, z / size, here)
    k = tl.arange(0, WIDTH)
    some = here[:, None] & (k < D - 1)[None, :]
    rest = tl.load(network + n[:, None] * (D + 3) + 1 + k[None, :], mask=some, other=0.0)
    tl.store(features + n[:, None] * (5 + D) + 6 + k[None, :], rest, mask=some)


@triton.jit(do_not_specialize=["count"])
def _backward(
    network, positions, directions, lengths, sharpness, annealing, centre, scale, size, radius, rounding, floor,
    of_stopping, of_features, of_network, of_sharpness, count, D: tl.constexpr, INTERVALS: tl.constexpr,
    WIDTH: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    n, here = own_rows(count, BLOCK)
    s, annealing = tl.load(sharpness), tl.load(annealing)
    x, y, z, far, lower, distance = _distance(network, positions, centre, size, radius, rounding, floor, n, here, D + 3)
    grad = tl.load(of_stopping + n, mask=here, other=0.0)
    by_x, by_y, by_z = load_three(of_features + n * (5 + D), here)
    if INTERVALS:
        to_x, to_y, to_z = load_three(directions + n * 3, here)
        length = tl.load(lengths + n, mask=here, other=0.0)
        along_x, along_y, along_z = _gradient(network, x, y, z, far, lower, scale, size, floor, n, here, D + 3)
        cosine = along_x * to_x + along_y * to_y + along_z * to_z
        half = _half(cosine, length, annealing)
        inside, outside = _logistic(s * (distance - half))
        fall = 2 * s * half
        kept, shared = tl.exp(-fall), inside * opacity_of(fall) * outside
        by_distance = -s * shared
        by_half = s * (shared + 2 * inside * kept)
        by_s = 2 * half * inside * kept - shared * (distance - half)
        slope = tl.where(cosine < 0, -annealing, 0.0) - tl.where(cosine < 1, 0.5 * (1 - annealing), 0.0)
        by_cosine = grad * by_half * slope * length * 0.5
        by_x += by_cosine * to_x
        by_y += by_cosine * to_y
        by_z += by_cosine * to_z
    else:
        outside = 0.5 * tl.exp(-s * tl.abs(distance))
        by_distance = -s * s * outside
        by_s = tl.where(distance > 0, outside, 1 - outside) - s * distance * outside
    tl.atomic_add(of_sharpness, tl.sum(tl.where(here, grad * by_s, 0.0), 0), sem="relaxed")
    to = of_network + n * (D + 3)
    tl.store(to, size * grad * by_distance, mask=here)
    by_x, by_y, by_z = size * tl.load(scale) * by_x, size * tl.load(scale + 1) * by_y, size * tl.load(scale + 2) * by_z
    store_three(to + D, by_x, by_y, by_z, here)
    k = tl.arange(0, WIDTH)
    some = here[:, None] & (k < D - 1)[None, :]
    rest = tl.load(of_features + n[:, None] * (5 + D) + 6 + k[None, :], mask=some, other=0.0)
    tl.store(of_network + n[:, None] * (D + 3) + 1 + k[None, :], rest, mask=some)


class _Samples(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, network: Tensor, sharpness: Tensor, first: FirstShape, annealing: Tensor, *rows: Tensor
    ) -> tuple[Tensor, Tensor]:
        ctx.save_for_backward(network, sharpness, annealing, *rows)
        ctx.first = first
        count, outputs = len(network), network.shape[1] - 3
        stopping, features = network.new_empty(count), network.new_empty(count, PLACED + outputs - 1)
        launch(
            _forward, (blocks(count, BLOCK),), network, *_inputs(rows, sharpness, annealing, first), stopping,
            features, count, **_constants(outputs, rows),
        )  # fmt: skip
        return stopping, features

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, of_stopping: Tensor, of_features: Tensor) -> tuple[Tensor | None, ...]:
        network, sharpness, annealing, *rows = ctx.saved_tensors
        of_network, of_sharpness, count = torch.empty_like(network), torch.zeros_like(sharpness), len(network)
        launch(
            _backward, (blocks(count, BLOCK),), network, *_inputs(rows, sharpness, annealing, ctx.first),
            of_stopping.contiguous(), of_features.contiguous(), of_network, of_sharpness, count,
            **_constants(network.shape[1] - 3, rows),
        )  # fmt: skip
        return of_network, of_sharpness, *[None] * (2 + len(rows))


def _inputs(rows: Any, sharpness: Tensor, annealing: Tensor, first: FirstShape) -> tuple[Any, ...]:
    """Return the arguments of both kernels after the network; positions replace missing arguments."""
    positions, directions, lengths = rows if len(rows) == 3 else (rows[0],) * 3
    return positions, directions, lengths, sharpness, annealing, *first


def _constants(outputs: int, rows: Any) -> dict[str, Any]:
    width = triton.next_power_of_2(max(outputs - 1, 1))
    return {"D": outputs, "INTERVALS": len(rows) == 3, "WIDTH": width, "BLOCK": BLOCK}


def surface_samples(
    network: Tensor, sharpness: Tensor, positions: Tensor, first: FirstShape, intervals: Intervals | None = None
) -> tuple[Tensor, Tensor]:
    """Compute `samples.surface_samples` of `network`, `sharpness`, `positions`, `first` and `intervals`."""
    rows, annealing = [positions.contiguous()], 1.0
    if intervals is not None:
        rows += [intervals.directions.contiguous(), intervals.lengths.contiguous()]
        annealing = intervals.annealing
    return _Samples.apply(network.contiguous(), sharpness, first, on_device(annealing, network), *rows)


@triton.jit
def _normal(features, n, here, F: tl.constexpr, SHORTEST: tl.constexpr):
    """Return a unit vector, and its length; 0 and 1 where it is too short."""
    x, y, z = load_three(features + n * F, here)
    largest = tl.maximum(tl.maximum(tl.abs(x), tl.abs(y)), tl.abs(z))
    unit = tl.where(largest < SHORTEST, 1.0, largest)
    x, y, z = x / unit, y / unit, z / unit
    length = tl.sqrt(x * x + y * y + z * z)
    some = length * unit >= SHORTEST
    safe = tl.where(some, length, 1.0)
    return tl.where(some, x / safe, 0.0), tl.where(some, y / safe, 0.0), tl.where(some, z / safe, 0.0), safe * unit


@triton.jit(do_not_specialize=["count"])
def _unit(features, out, count, F: tl.constexpr, WIDTH: tl.constexpr, SHORTEST: tl.constexpr, BLOCK: tl.constexpr):
    n, here = own_rows(count, BLOCK)
    x, y, z, _ = _normal(features, n, here, F, SHORTEST)
    store_three(out + n * F, x, y, z, here)
    k = tl.arange(0, WIDTH)
    at, some = n[:, None] * F + k[None, :], here[:, None] & ((k >= 3) & (k < F))[None, :]
    tl.store(out + at, tl.load(features + at, mask=some, other=0.0), mask=some)


@triton.jit(do_not_specialize=["count"])
def _unit_backward(
    features, grad, out, count, F: tl.constexpr, WIDTH: tl.constexpr, SHORTEST: tl.constexpr, BLOCK: tl.constexpr
):
    n, here = own_rows(count, BLOCK)
    x, y, z, length = _normal(features, n, here, F, SHORTEST)
    by_x, by_y, by_z = load_three(grad + n * F, here)
    along = x * by_x + y * by_y + z * by_z
    by_x, by_y, by_z = (by_x - along * x) / length, (by_y - along * y) / length, (by_z - along * z) / length
    some = (x != 0) | (y != 0) | (z != 0)
    store_three(out + n * F, tl.where(some, by_x, 0.0), tl.where(some, by_y, 0.0), tl.where(some, by_z, 0.0), here)
    k = tl.arange(0, WIDTH)
    at, rest = n[:, None] * F + k[None, :], here[:, None] & ((k >= 3) & (k < F))[None, :]
    tl.store(out + at, tl.load(grad + at, mask=rest, other=0.0), mask=rest)


class _UnitNormals(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, features: Tensor) -> Tensor:
        ctx.save_for_backward(features)
        out, count = torch.empty_like(features), len(features)
        launch(_unit, (blocks(count, BLOCK),), features, out, count, **_widths(features))
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        (features,) = ctx.saved_tensors
        out, count = torch.empty_like(features), len(features)
        launch(
            _unit_backward, (blocks(count, BLOCK),), features, grad.contiguous(), out, count, **_widths(features)
        )  # fmt: skip
        return out


def _widths(features: Tensor) -> dict[str, Any]:
    width = features.shape[1]
    return {"F": width, "WIDTH": triton.next_power_of_2(width), "SHORTEST": SHORTEST, "BLOCK": BLOCK}


def unit_normals(features: Tensor) -> Tensor:
    """Compute `nerfloom.kernels.surfaces.samples.unit_normals` of `features`."""
    return _UnitNormals.apply(features.contiguous())
