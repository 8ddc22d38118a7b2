"""Blending of Gaussians, forward and backward, in Triton. `nerfloom.kernels.splats.blend` has the equations.

A program processes a tile, in batches of Gaussians at all pixels together. Transmittances within a batch are cumulative
products. In the backward pass each entry of a tile's list has its own sums over the tile's pixels, which are added by
Gaussian in a fixed order, without atomics, so that results are reproducible bit for bit.
"""

# mypy: allow-untyped-defs, allow-untyped-decorators, allow-incomplete-defs
# Triton gives the kernels' arguments their types.

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from nerfloom.kernels.splats import blend as blending
from nerfloom.kernels.splats import project, tiles
from nerfloom.kernels.splats.blend import Blended
from nerfloom.kernels.splats.record_triton import (
    BLUE,
    CUT,
    DISTANCE,
    GREEN,
    NORMAL_X,
    NORMAL_Y,
    NORMAL_Z,
    OPACITY,
    REACH_X,
    RECORD,
    RED,
    U_X,
    U_Y,
    V_Y,
    X,
    Y,
)
from nerfloom.kernels.splats.tiles import TileLists
from nerfloom.kernels.triton_launch import blocks, launch, load_three, own_rows, store_three

BATCH = 8
"""Gaussians that are evaluated together."""
BLOCK = 32
"""Number of Gaussians that add up the sums of their entries together."""
TILE, PIXELS = tl.constexpr(tiles.TILE), tl.constexpr(tiles.TILE**2)
MAX_ALPHA, OPAQUE = tl.constexpr(blending.MAX_ALPHA), tl.constexpr(blending.OPAQUE)
SUM_X, SUM_Y, SUM_XX, SUM_XY, SUM_YY = (tl.constexpr(k) for k in range(5))
SUM_G, ABSOLUTE_X, ABSOLUTE_Y = tl.constexpr(5), tl.constexpr(6), tl.constexpr(7)
"""Columns of the sums over an entry's pixels that differ from the record's."""


@triton.jit
def _pixels(tile, columns, width, height):
    """Return the positions x, y of a tile's pixels, their indices in the image, and whether they are on it."""
    i = tl.arange(0, PIXELS)
    column, row = tile % columns * TILE + i % TILE, tile // columns * TILE + i // TILE
    on = (column < width) & (row < height)
    return column.to(tl.float32) + 0.5, row.to(tl.float32) + 0.5, row.to(tl.int64) * width + column, on


@triton.jit
def _column(record, listed, k: tl.constexpr):
    """Return a column (1, G) of the records of a batch, 0 beyond the list's end."""
    return tl.load(record + k, mask=listed, other=0.0)[None, :]


@triton.jit
def _alphas(record, listed, x, y, through):
    """Return the offsets (P, G) of pixels from Gaussians, alphas before and after they are bounded, and transmittances.

    Each transmittance is in front of the Gaussian; alphas are 0 where nothing is blended.
    """
    dx, dy = x[:, None] - _column(record, listed, X), y[:, None] - _column(record, listed, Y)
    u = _column(record, listed, U_X) * dx + _column(record, listed, U_Y) * dy
    v = _column(record, listed, V_Y) * dy
    q = u * u + v * v
    raw = tl.where(q < _column(record, listed, CUT), _column(record, listed, OPACITY) * tl.exp(-q), 0.0)
    alpha = tl.where(raw > MAX_ALPHA, MAX_ALPHA, raw)
    before = through[:, None] * (tl.cumprod(1 - alpha, 1) / (1 - alpha))
    blended = before >= OPAQUE
    return dx, dy, raw, tl.where(blended, alpha, 0.0), before


@triton.jit
def _forward(
    records, offsets, ids, background, image, through_image, median_image, used, width, height, columns,
    CHANNELS: tl.constexpr, BATCH: tl.constexpr,
):  # fmt: skip
    tile = tl.program_id(0)
    n, end = tl.load(offsets + tile), tl.load(offsets + tile + 1)
    x, y, pixel, on = _pixels(tile, columns, width, height)
    through = tl.where(on, 1.0, 0.0)
    red = tl.zeros([PIXELS], tl.float32)
    green, blue, distance, normal_x, normal_y, normal_z, median = red, red, red, red, red, red, red
    while (n < end) & (tl.max(through, 0) >= OPAQUE):
        entry = n + tl.arange(0, BATCH)
        listed = entry < end
        record = records + tl.load(ids + entry, mask=listed, other=0).to(tl.int64) * RECORD
        _, _, _, alpha, before = _alphas(record, listed, x, y, through)
        weight = alpha * before
        after = before * (1 - alpha)
        red += tl.sum(weight * _column(record, listed, RED), 1)
        green += tl.sum(weight * _column(record, listed, GREEN), 1)
        blue += tl.sum(weight * _column(record, listed, BLUE), 1)
        if CHANNELS > 3:
            distance += tl.sum(weight * _column(record, listed, DISTANCE), 1)
        if CHANNELS > 4:
            normal_x += tl.sum(weight * _column(record, listed, NORMAL_X), 1)
            normal_y += tl.sum(weight * _column(record, listed, NORMAL_Y), 1)
            normal_z += tl.sum(weight * _column(record, listed, NORMAL_Z), 1)
        if median_image is not None:
            crossed = (before > 0.5) & (after <= 0.5)
            median += tl.sum(tl.where(crossed, _column(record, listed, DISTANCE), 0.0), 1)
        # Gaussians that are no longer blended have a lower transmittance.
        through = tl.min(tl.where(before >= OPAQUE, after, through[:, None]), 1)
        n += BATCH
    tl.store(used + tile, tl.minimum(n, end) - tl.load(offsets + tile))
    image += pixel * CHANNELS
    red += through * tl.load(background)
    green += through * tl.load(background + 1)
    blue += through * tl.load(background + 2)
    store_three(image, red, green, blue, on)
    if CHANNELS > 3:
        tl.store(image + 3, distance, mask=on)
    if CHANNELS > 4:
        store_three(image + 4, normal_x, normal_y, normal_z, on)
    tl.store(through_image + pixel, through, mask=on)
    if median_image is not None:
        tl.store(median_image + pixel, median, mask=on)


@triton.jit
def _put_shape(part, listed, record, exponent, dx, dy):
    """Write an entry's sums over pixels of the exponent's gradient times products of the offsets."""
    by_x, by_y = exponent * dx, exponent * dy
    tl.store(part + SUM_G, tl.sum(exponent, 0), mask=listed)
    tl.store(part + SUM_X, tl.sum(by_x, 0), mask=listed)
    tl.store(part + SUM_Y, tl.sum(by_y, 0), mask=listed)
    tl.store(part + SUM_XX, tl.sum(by_x * dx, 0), mask=listed)
    tl.store(part + SUM_XY, tl.sum(by_x * dy, 0), mask=listed)
    tl.store(part + SUM_YY, tl.sum(by_y * dy, 0), mask=listed)
    u_x, u_y, v_y = _column(record, listed, U_X), _column(record, listed, U_Y), _column(record, listed, V_Y)
    of_x = 2 * u_x * (u_x * by_x + u_y * by_y)
    of_y = 2 * (u_y * (u_x * by_x + u_y * by_y) + v_y * v_y * by_y)
    tl.store(part + ABSOLUTE_X, tl.sum(tl.abs(of_x), 0), mask=listed)
    tl.store(part + ABSOLUTE_Y, tl.sum(tl.abs(of_y), 0), mask=listed)


@triton.jit
def _backward(
    records, offsets, ids, slots, image, through_image, used, of_image, of_through, parts, width, height, columns,
    CHANNELS: tl.constexpr, BATCH: tl.constexpr,
):  # fmt: skip
    tile = tl.program_id(0)
    begin = tl.load(offsets + tile)
    end = begin + tl.load(used + tile)
    x, y, pixel, on = _pixels(tile, columns, width, height)
    through = tl.where(on, 1.0, 0.0)
    image += pixel * CHANNELS
    of_image += pixel * CHANNELS
    red, green, blue = load_three(of_image, on)
    # The light from behind a Gaussian is the whole image minus the Gaussian and everything in front of it.
    behind = red * tl.load(image, mask=on, other=0.0) + green * tl.load(image + 1, mask=on, other=0.0)
    behind += blue * tl.load(image + 2, mask=on, other=0.0)
    if CHANNELS > 3:
        far = tl.load(of_image + 3, mask=on, other=0.0)
        behind += far * tl.load(image + 3, mask=on, other=0.0)
    if of_through is not None:
        last = tl.load(through_image + pixel, mask=on, other=0.0)
        behind += last * tl.load(of_through + pixel, mask=on, other=0.0)
    for n in range(begin, end, BATCH):
        entry = n + tl.arange(0, BATCH)
        listed = entry < end
        record = records + tl.load(ids + entry, mask=listed, other=0).to(tl.int64) * RECORD
        part = parts + tl.load(slots + entry, mask=listed, other=0).to(tl.int64) * RECORD
        dx, dy, raw, alpha, before = _alphas(record, listed, x, y, through)
        weight = alpha * before
        own = _column(record, listed, RED) * red[:, None] + _column(record, listed, GREEN) * green[:, None]
        own += _column(record, listed, BLUE) * blue[:, None]
        if CHANNELS > 3:
            own += _column(record, listed, DISTANCE) * far[:, None]
            tl.store(part + DISTANCE, tl.sum(weight * far[:, None], 0), mask=listed)
        tl.store(part + RED, tl.sum(weight * red[:, None], 0), mask=listed)
        tl.store(part + GREEN, tl.sum(weight * green[:, None], 0), mask=listed)
        tl.store(part + BLUE, tl.sum(weight * blue[:, None], 0), mask=listed)
        rest = behind[:, None] - tl.cumsum(weight * own, 1)
        # The gradient of the exponent: alpha times the gradient of alpha, 0 if alpha is clipped.
        exponent = tl.where(raw < MAX_ALPHA, alpha * (before * own - rest / (1 - alpha)), 0.0)
        _put_shape(part, listed, record, exponent, dx, dy)
        behind -= tl.sum(weight * own, 1)
        through = tl.min(tl.where(before >= OPAQUE, before * (1 - alpha), through[:, None]), 1)


@triton.jit
def _sum(total, k: tl.constexpr):
    """Return a column of the sums (G, RECORD)."""
    return tl.sum(tl.where(tl.arange(0, RECORD)[None, :] == k, total, 0.0), 1)


@triton.jit(do_not_specialize=["count"])
def _gather(records, firsts, parts, out, count, BLOCK: tl.constexpr):
    """Add up the sums of each Gaussian's entries, in the order of the tiles, and write the gradient of its record."""
    g, here = own_rows(count, BLOCK)
    k = tl.arange(0, RECORD)
    begin = tl.load(firsts + g, mask=here, other=0)
    entries = tl.load(firsts + g + 1, mask=here, other=0) - begin
    total = tl.zeros([BLOCK, RECORD], tl.float32)
    for i in range(tl.max(entries, 0)):
        slot = (begin + i).to(tl.int64)
        total += tl.load(parts + slot[:, None] * RECORD + k[None, :], mask=(i < entries)[:, None], other=0.0)
    record, row = records + g * RECORD, out + g * RECORD
    tl.store(row[:, None] + k[None, :], total, mask=here[:, None] & (k >= RED)[None, :] & (k < NORMAL_X)[None, :])
    tl.store(row[:, None] + k[None, :], tl.zeros_like(total), mask=here[:, None] & (k >= NORMAL_X)[None, :])
    u_x = tl.load(record + U_X, mask=here, other=0.0)
    u_y = tl.load(record + U_Y, mask=here, other=0.0)
    v_y = tl.load(record + V_Y, mask=here, other=0.0)
    opacity = tl.load(record + OPACITY, mask=here, other=0.0)
    sum_x, sum_y, sum_xy = _sum(total, SUM_X), _sum(total, SUM_Y), _sum(total, SUM_XY)
    by_u = u_x * sum_x + u_y * sum_y
    tl.store(row + X, 2 * u_x * by_u, mask=here)
    tl.store(row + Y, 2 * (u_y * by_u + v_y * v_y * sum_y), mask=here)
    tl.store(row + U_X, -2 * (u_x * _sum(total, SUM_XX) + u_y * sum_xy), mask=here)
    tl.store(row + U_Y, -2 * (u_x * sum_xy + u_y * _sum(total, SUM_YY)), mask=here)
    tl.store(row + V_Y, -2 * v_y * _sum(total, SUM_YY), mask=here)
    of_opacity = _sum(total, SUM_G) / tl.where(opacity > 0, opacity, 1.0)
    tl.store(row + OPACITY, tl.where(opacity > 0, of_opacity, 0.0), mask=here)
    tl.store(row + CUT, _sum(total, ABSOLUTE_X), mask=here)
    tl.store(row + REACH_X, _sum(total, ABSOLUTE_Y), mask=here)


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, records: Tensor, lists: TileLists, width: int, height: int, background: Tensor, channels: int,
        median: bool,
    ) -> tuple[Tensor, Tensor, Tensor | None]:  # fmt: skip
        image, through = records.new_empty(height, width, channels), records.new_empty(height, width)
        middle = records.new_empty(height, width) if median else None
        count = len(lists.offsets) - 1
        used = torch.empty(count, dtype=torch.int32, device=records.device)
        launch(
            _forward, (count,), records, lists.offsets, lists.ids, background, image, through, middle, used, width,
            height, blocks(width, tiles.TILE), CHANNELS=channels, BATCH=BATCH, num_warps=8,
        )  # fmt: skip
        ctx.save_for_backward(records, *lists[:4], image, through, used)
        if middle is not None:
            ctx.mark_non_differentiable(middle)
        ctx.set_materialize_grads(False)
        return image, through, middle

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        records, offsets, ids, slots, firsts, image, through, used = ctx.saved_tensors
        height, width, channels = image.shape
        of_image = torch.zeros_like(image) if grads[0] is None else grads[0].contiguous()
        of_through = None if grads[1] is None else grads[1].contiguous()
        parts, out = records.new_zeros(len(ids), project.RECORD), torch.empty_like(records)
        launch(
            _backward, (len(used),), records, offsets, ids, slots, image, through, used, of_image, of_through, parts,
            width, height, blocks(width, tiles.TILE), CHANNELS=channels, BATCH=BATCH, num_warps=8,
        )  # fmt: skip
        launch(_gather, (blocks(len(records), BLOCK),), records, firsts, parts, out, len(records), BLOCK=BLOCK)
        return out, None, None, None, None, None, None


def blend(
    records: Tensor, lists: TileLists, width: int, height: int, background: Tensor, channels: int, median: bool
) -> Blended:
    """Compute `blend.blend` of `records`, `lists`, `width`, `height`, `background`, `channels` and `median`.

    Images of 3 or 4 channels have first derivatives.
    """
    return Blended(*_Blend.apply(records.contiguous(), lists, width, height, background.contiguous(), channels, median))
