"""Lists of the Gaussians that each tile of an image shows, in Triton; the reference: `nerfloom.kernels.splats.tiles`.

Each entry's key is its tile, above the bits of the distance or of another sort key. The bits of positive floats
increase with the value, so one stable sort orders all entries, with equal distances by Gaussian. The host synchronises
once, for the number of entries, unless a capacity is given; keys of unused capacity come last.
"""

# mypy: allow-untyped-defs, allow-untyped-decorators, allow-incomplete-defs
# Triton gives the kernels' arguments their types.

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from nerfloom.kernels.splats import tiles
from nerfloom.kernels.splats.project import Record
from nerfloom.kernels.splats.record_triton import CUT, REACH_X, REACH_Y, RECORD, U_X, U_Y, V_Y, X, Y
from nerfloom.kernels.splats.tiles import TileLists
from nerfloom.kernels.triton_launch import blocks, launch, own_rows

BLOCK = 32
"""Gaussians that are taken together, by one warp."""
LAST = 2**63 - 1
"""Key larger than the keys of all entries."""
TILE = tl.constexpr(tiles.TILE)


@triton.jit
def _span(centre, reach, count):
    """Return the range (first, end) of tiles along an axis where a Gaussian's box contains a pixel's centre."""
    low = tl.ceil((centre - reach - (TILE - 0.5)) / TILE)
    high = tl.floor((centre + reach - 0.5) / TILE) + 1
    most = count * 1.0
    low = tl.where(low > 0, low, 0.0)  # by comparisons that NaN fails
    high = tl.where(high > 0, high, 0.0)
    return tl.where(low < most, low, most).to(tl.int32), tl.where(high < most, high, most).to(tl.int32)


@triton.jit
def _touches(record, here, column, row):
    """Return whether an ellipse comes within CUT on a tile: the least of a quadratic form over a rectangle."""
    x0 = column.to(tl.float32) * TILE + 0.5 - tl.load(record + X, mask=here, other=0.0)
    y0 = row.to(tl.float32) * TILE + 0.5 - tl.load(record + Y, mask=here, other=0.0)
    u_x = tl.load(record + U_X, mask=here, other=1.0)
    u_y = tl.load(record + U_Y, mask=here, other=0.0)
    v_y = tl.load(record + V_Y, mask=here, other=1.0)
    x1, y1 = x0 + (TILE - 1), y0 + (TILE - 1)
    near_x = tl.where(x0 > 0, x0, tl.where(x1 < 0, x1, 0.0))
    near_y = tl.where(y0 > 0, y0, tl.where(y1 < 0, y1, 0.0))
    # Along the vertical edge that faces the centre, and along the horizontal one.
    y = tl.minimum(tl.maximum(-u_x * u_y * near_x / (u_y * u_y + v_y * v_y), y0), y1)
    u, v = u_x * near_x + u_y * y, v_y * y
    by_x = tl.where(near_x != 0, u * u + v * v, 3e38)
    x = tl.minimum(tl.maximum(-u_y * near_y / u_x, x0), x1)
    u, v = u_x * x + u_y * near_y, v_y * near_y
    by_y = tl.where(near_y != 0, u * u + v * v, 3e38)
    within = tl.minimum(by_x, by_y) <= tl.load(record + CUT, mask=here, other=0.0) * 1.0001
    return within | ((near_x == 0) & (near_y == 0))


@triton.jit(do_not_specialize=["count"])
def _list(records, distances, counts, firsts, keys, owners, count, columns, rows, BLOCK: tl.constexpr):
    """Count the tiles of each Gaussian, or, if there are `firsts`, write the keys and owners of the entries."""
    g, here = own_rows(count, BLOCK)
    record = records + g * RECORD
    here = here & (tl.load(record + CUT, mask=here, other=0.0) > 0)
    if firsts is not None:
        first = tl.load(firsts + g, mask=here, other=0)
        here = here & (tl.load(firsts + g + 1, mask=here, other=0) > first)  # else it is full
        distance = tl.load(distances + g, mask=here, other=0.0).to(tl.int32, bitcast=True).to(tl.int64)
    x = tl.load(record + X, mask=here, other=0.0)
    y = tl.load(record + Y, mask=here, other=0.0)
    left, right = _span(x, tl.load(record + REACH_X, mask=here, other=0.0), columns)
    top, bottom = _span(y, tl.load(record + REACH_Y, mask=here, other=0.0), rows)
    wide = tl.where(here, tl.maximum(right - left, 0), 0)
    spanned = wide * tl.maximum(bottom - top, 0)
    found = tl.zeros([BLOCK], tl.int32)
    for k in range(tl.max(spanned, 0)):
        inside = k < spanned
        across = tl.maximum(wide, 1)
        column, row = left + k % across, top + k // across
        listed = inside & ((spanned == 1) | _touches(record, inside, column, row))
        if firsts is not None:
            tile = row.to(tl.int64) * columns + column
            tl.store(keys + first + found, (tile << 32) + distance, mask=listed)
            tl.store(owners + first + found, g.to(tl.int32), mask=listed)
        found += listed.to(tl.int32)
    if firsts is None:
        tl.store(counts + g, found, mask=g < count)


def tile_lists(
    records: Tensor, width: int, height: int, for_gradients: bool = True, capacity: int | None = None,
    keys: Tensor | None = None,
) -> TileLists:  # fmt: skip
    """Compute `tiles.tile_lists` of `records`, `width`, `height`, `for_gradients`, `capacity` and `keys`.

    A Gaussian is listed in a tile only if its ellipse reaches it, not its box alone.

    Raises:
        ValueError: if there are 2^31 entries or more.
    """
    records, count, device = records.contiguous(), len(records), records.device
    columns, rows = blocks(width, tiles.TILE), blocks(height, tiles.TILE)
    distances = (records[:, Record.DISTANCE] if keys is None else keys).contiguous()
    counts, programs = torch.empty(count, dtype=torch.int32, device=device), (blocks(count, BLOCK),)
    shared = (count, columns, rows)
    launch(_list, programs, records, distances, counts, None, None, None, *shared, BLOCK=BLOCK, num_warps=1)
    needed = None if capacity is None else counts.sum()
    if capacity is None:
        capacity = int(counts.sum())
    else:
        counts = counts.masked_fill(counts.cumsum(0) > capacity, 0)
    if capacity >= 2**31:
        raise ValueError("more than 2^31 Gaussians on the image's tiles")
    firsts = torch.nn.functional.pad(counts.cumsum(0), (1, 0))
    places = torch.full((capacity,), LAST, dtype=torch.int64, device=device)
    owners = torch.zeros(capacity, dtype=torch.int32, device=device)
    launch(_list, programs, records, distances, None, firsts, places, owners, *shared, BLOCK=BLOCK, num_warps=1)
    places, slots = places.sort(stable=True)
    first_keys = torch.arange(columns * rows + 1, device=device) << 32
    offsets = torch.searchsorted(places, first_keys, out_int32=True)
    return TileLists(offsets, owners.index_select(0, slots), slots.int(), firsts.int(), needed)
