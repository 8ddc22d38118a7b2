"""Lists of the Gaussians that each tile of an image shows, from front to back.

The Gaussians are sorted once (a radix sort of 32-bit keys), by distance or by given keys, and then appended in this
order to the list of each tile that they touch, so that these lists are sorted too.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from nerfloom.kernels import native
from nerfloom.kernels.dispatch import CPP, FEW_OPERATIONS, TRITON, Operation
from nerfloom.kernels.splats.project import RECORD, Record
from nerfloom.kernels.triton_backend import later

TILE = 16
"""Pixels along a tile's edge."""


class TileLists(NamedTuple):
    """Lists of T tiles, row by row, with E entries in all; an entry is a Gaussian that a tile may show."""

    offsets: Tensor
    """(T + 1,) int32; tile t has the entries from offsets[t] to offsets[t + 1] - 1, from front to back."""
    ids: Tensor
    """(E,) int32 index of each entry's Gaussian. Behind the last tile's there may be some without a meaning."""
    slots: Tensor
    """(E,) int32 index of each entry in the order by Gaussian, then by tile; (0,) unless `for_gradients`."""
    firsts: Tensor
    """(N + 1,) int32; Gaussian g has the slots from firsts[g] to firsts[g + 1] - 1."""
    needed: Tensor | None = None
    """() int64 number of entries with unlimited capacity; None if the capacity was sufficient."""


def tile_lists(
    records: Tensor, width: int, height: int, for_gradients: bool = True, capacity: int | None = None,
    keys: Tensor | None = None,
) -> TileLists:  # fmt: skip
    """Return lists of the Gaussians that each tile of an image may show, nearest first, and by index at equal distance.

    Args:
        records: (N, RECORD) Gaussians on the image, from `project_gaussians`.
        width, height: size of the image, pixels.
        for_gradients: whether a backward pass follows; otherwise the lists may have no slots.
        capacity: number of entries, which avoids a synchronisation; Gaussians beyond it are dropped entirely. None for
            no limit.
        keys: (N,) positive numbers that sort the visible Gaussians instead, smallest first.

    Raises:
        ValueError: if there is another number of keys than of Gaussians.
    """
    if keys is not None and keys.shape != (len(records),):
        raise ValueError(f"{len(records)} Gaussians are sorted by as many keys, not by {tuple(keys.shape)}")
    records, keys = records.detach(), None if keys is None else keys.detach()
    return TILES((records, keys), records, width, height, for_gradients, capacity, keys)


def tile_lists_reference(
    records: Tensor, width: int, height: int, for_gradients: bool = True, capacity: int | None = None,
    keys: Tensor | None = None,
) -> TileLists:  # fmt: skip
    """Compute `tile_lists` in torch. A Gaussian is listed in every tile that the box around it touches.

    `records`, `width`, `height`, `capacity` and `keys` are as in `tile_lists`; `for_gradients` makes no difference.
    """
    columns, rows = -(-width // TILE), -(-height // TILE)
    device = records.device
    order = _keys(records, keys).sort(stable=True).indices
    order = order[records[order, Record.CUT] > 0]
    x, y, wide, high = records[order][:, [Record.X, Record.Y, Record.REACH_X, Record.REACH_Y]].unbind(-1)
    edges_x, edges_y = (torch.arange(count, device=device) * TILE for count in (columns, rows))

    def met(center: Tensor, reach: Tensor, edges: Tensor) -> Tensor:
        after = (center + reach)[:, None] >= edges + 0.5
        return after & ((center - reach)[:, None] <= edges + TILE - 0.5)

    touched = (met(y, high, edges_y)[:, :, None] & met(x, wide, edges_x)[:, None]).flatten(1)
    needed = None
    if capacity is not None:
        needed, touched = touched.sum(), touched & (touched.sum(1).cumsum(0) <= capacity)[:, None]
    place, tile = touched.nonzero().unbind(-1)  # by Gaussian in order of distance, then by tile
    return _dealt(order.index_select(0, place), tile, columns * rows, len(records))._replace(needed=needed)


def _keys(records: Tensor, keys: Tensor | None) -> Tensor:
    """Return the numbers (N,) that sort Gaussians: their distances, if no others are given."""
    return records[:, Record.DISTANCE] if keys is None else keys


def _dealt(ids: Tensor, tiles: Tensor, num_tiles: int, num_gaussians: int) -> TileLists:
    """Return the lists from entries (E,), pairs of a Gaussian and a tile by distance. Empty entries have the
    indices `num_gaussians` and `num_tiles`, and come last."""
    by_tile = tiles.sort(stable=True).indices
    ids = ids.index_select(0, by_tile)
    slots = torch.empty_like(ids)
    slots[ids.sort(stable=True).indices] = torch.arange(len(ids), device=ids.device)
    starts = [
        torch.nn.functional.pad(counts[:-1].cumsum(0), (1, 0)).int()
        for counts in (_counts(tiles, num_tiles + 1), _counts(ids, num_gaussians + 1))
    ]
    return TileLists(starts[0], ids.clamp(max=max(num_gaussians - 1, 0)).int(), slots.int(), starts[1])


def _counts(values: Tensor, count: int) -> Tensor:
    """Return how often each of the integers from 0 to `count` - 1 is among `values`; no device is waited for."""
    return values.new_zeros(count).index_add_(0, values, torch.ones_like(values))


TILES: Operation[..., TileLists] = Operation("tile_lists", tile_lists_reference)


@TILES.implementation(FEW_OPERATIONS, types=None)
def _by_entries(
    records: Tensor, width: int, height: int, for_gradients: bool = True, capacity: int | None = None,
    keys: Tensor | None = None,
) -> TileLists:  # fmt: skip
    """Compute `tile_lists` without a table of all Gaussians and tiles; the device is waited for once, if no capacity is
    given. The nearest Gaussians have it."""
    count, device = len(records), records.device
    columns, rows = -(-width // TILE), -(-height // TILE)
    order = torch.sort(_keys(records, keys), stable=True).indices
    sorted_records = records.index_select(0, order)
    x, y, wide, high = (sorted_records[:, column] for column in (Record.X, Record.Y, Record.REACH_X, Record.REACH_Y))
    left, right = _met(x, wide, columns)
    top, bottom = _met(y, high, rows)
    across, down = (right - left).clamp(min=0), (bottom - top).clamp(min=0)
    counts = (across * down).masked_fill(sorted_records[:, Record.CUT] <= 0, 0)
    needed = None if capacity is None else counts.sum()
    if capacity is None:
        capacity = int(counts.sum())
    else:
        counts = counts.masked_fill(counts.cumsum(0) > capacity, 0)
    ends = counts.cumsum(0)
    place = torch.arange(capacity, device=device)
    owners = torch.searchsorted(ends, place, right=True)
    none, owners = owners == count, owners.clamp(max=count - 1)
    number = place - (ends - counts).index_select(0, owners)
    along = across.index_select(0, owners).clamp(min=1)
    column = left.index_select(0, owners) + number % along
    row = top.index_select(0, owners) + number // along
    ids = order.index_select(0, owners).masked_fill(none, count)
    tiles = (row * columns + column).masked_fill(none, columns * rows)
    return _dealt(ids, tiles, columns * rows, count)._replace(needed=needed)


def _met(centers: Tensor, reaches: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return the first (N,) of `count` tiles in a row with a pixel within reach, and the one behind the last."""
    first = ((centers - reaches - (TILE - 0.5)) / TILE).ceil().clamp(0, count)
    last = ((centers + reaches - 0.5) / TILE).floor().clamp(-1, count - 1)
    return first.long(), last.long() + 1


_sort = native.Function("splat_sort", "pqpqp", "q")
_bound = native.Function("splat_bound", "pqiii", "q")
_bin = native.Function("splat_bin", "pqpqiiqppppi", "q")


@TILES.implementation(CPP, fits=lambda *given: given[4] is None)  # without a capacity
def _compiled(
    records: Tensor, width: int, height: int, for_gradients: bool = True, capacity: int | None = None,
    keys: Tensor | None = None,
) -> TileLists:  # fmt: skip
    records = records.contiguous()  # kept until the kernels have read it
    count, threads = len(records), native.threads()
    tiles = -(-width // TILE) * -(-height // TILE)
    address = native.pointer(records, "the records", (count, RECORD))

    def whole(size: int) -> Tensor:
        return torch.empty(size, dtype=torch.int32)

    order, sorted_by = whole(count), _keys(records, keys)
    visible = _sort(address, count, sorted_by.data_ptr(), sorted_by.stride(0), order.data_ptr())
    bound = _bound(address, count, width, height, threads)
    offsets, ids, firsts = whole(tiles + 1), whole(bound), whole(count + 1)
    slots = whole(bound if for_gradients else 0)
    entries = _bin(
        address, count, order.data_ptr(), visible, width, height, bound, firsts.data_ptr(), offsets.data_ptr(),
        ids.data_ptr(), slots.data_ptr() if for_gradients else None, threads,
    )  # fmt: skip
    return TileLists(offsets, ids[:entries], slots[:entries], firsts)


TILES.implementation(TRITON)(later("splats.tiles_triton", "tile_lists"))
