"""Bands of rows of factors at positions drawn on the device, so that a step that reads them can be captured."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from nerfloom.kernels.grids.planes_layout import PlanesLayout

Rows = tuple[int, int, int]
"""Group, factor in the group, and number of rows of a band."""


class _Bands(NamedTuple):
    """Entries of K bands, E in total, before their positions are drawn."""

    entries: Tensor
    """(E,) int64 entries of the table if each band were at its factor's first row."""
    owners: Tensor
    """(E,) int64 band of each entry."""
    across: Tensor
    """(K,) int64 entries of a row."""
    above: Tensor
    """(K,) int64 number of a band's rows minus 1; these may lie above the factor's first row when drawn."""
    last: Tensor
    """(K,) int64 last possible first row of a band."""


def drawn_bands(table: Tensor, layout: PlanesLayout, bands: Sequence[Rows]) -> list[Tensor]:
    """Return consecutive rows of factors at random positions, unknown to the host, in torch.

    A band that would extend beyond its factor is moved inside.

    Args:
        table: (E, F) entries of all factors.
        layout: axes, resolutions and offsets of the factors.
        bands: group, factor in the group and number of rows of each band; no more rows than the factor has.

    Returns:
        (rows, vertices along the first axis, F) entries of each band.
    """
    known = _known(layout, tuple(bands), table.device)
    spread = known.last + known.above + known.above + 1  # positions where a band has a row within the factor
    places = (torch.rand(len(bands), device=table.device) * spread).long() - known.above
    moved = torch.minimum(places.clamp(min=0), known.last) * known.across
    found = table.index_select(0, known.entries + moved.index_select(0, known.owners))
    shapes = [(rows, layout.shape(group, index)[1]) for group, index, rows in bands]
    parts = found.split([rows * across for rows, across in shapes])
    return [part.view(*shape, -1) for part, shape in zip(parts, shapes, strict=True)]


@lru_cache(maxsize=64)
def _known(layout: PlanesLayout, bands: tuple[Rows, ...], device: torch.device) -> _Bands:
    """Return the constants of bands; cached, because a copy to the device waits for it."""
    across = [layout.shape(group, index)[1] for group, index, _ in bands]
    firsts = [layout.offsets[group][index] for group, index, _ in bands]
    sizes = [rows * wide for (_, _, rows), wide in zip(bands, across, strict=True)]
    entries = torch.cat([torch.arange(first, first + size) for first, size in zip(firsts, sizes, strict=True)])
    owners = torch.arange(len(bands)).repeat_interleave(torch.tensor(sizes))
    above = torch.tensor([rows - 1 for _, _, rows in bands])
    last = torch.tensor([layout.shape(group, index)[0] - rows for group, index, rows in bands])
    return _Bands(*(column.to(device) for column in (entries, owners, torch.tensor(across), above, last)))
