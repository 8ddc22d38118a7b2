"""Feature planes and lines as a module with their table of features."""

from __future__ import annotations

from collections.abc import Container, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from nerfloom.base import device as devices
from nerfloom.base.optimised import Optimised
from nerfloom.encodings.coarse_to_fine import OpenLevels
from nerfloom.kernels.grids.drawn_bands import drawn_bands
from nerfloom.kernels.grids.plane_bands import Band, band_variation, plane_bands, variation
from nerfloom.kernels.grids.planes import PlanesGradient, planes
from nerfloom.kernels.grids.planes_layout import PlanesLayout
from nerfloom.kernels.table_memory import table

BANDS = 16
"""`FeaturePlanes.bands` divides the rows of a factor into this many bands."""


def scales_for(image_size: int, base: int, most: int) -> int:
    """Return the number of scales until the finest has a vertex per image pixel, at most `most`.

    Args:
        image_size: pixels along the images' longer side.
        base: vertices per axis at the coarsest scale; each further scale has twice as many.
        most: maximum number of scales.
    """
    scales = 1
    while scales < most and base << (scales - 1) < image_size:
        scales += 1
    return scales


def resolutions_of(box: Tensor, base: int, num_scales: int, time: tuple[int, ...] = ()) -> tuple[tuple[int, ...], ...]:
    """Return the vertices along each axis at each scale, equally far apart along x, y and z.

    Args:
        box: (2, 3) corners of the encoded region, scene units.
        base: vertices along the longest axis at the coarsest scale; each further scale has twice as many.
        num_scales: number of scales.
        time: vertices along further axes, the same at every scale.
    """
    size = box[1] - box[0]
    edges = (size / size.max()).tolist()
    return tuple(tuple(max(round((base << scale) * edge), 2) for edge in edges) + time for scale in range(num_scales))


class FeaturePlanes(nn.Module):
    """Factorised features over [0, 1]^D: K-Planes, section 3, and TensoRF, section 4. A fourth axis is time.

    Args:
        resolutions: vertices along each of the D axes, for each of G groups of factors.
        features_per_group: number F of features of a group.
        axes: the axis or two axes of each factor, per group; a plane for every pair of axes if None.
        sparse: whether the optimiser updates only the entries that a step has used, as for `HashGrid`.
        resizable: whether `resample` may be called; a checkpoint may then have other resolutions.
        opening: groups are scales that open from coarse to fine (`OpenLevels`) during this fraction of the training
            budget; 0: all are open.

    Raises:
        ConfigError: if a number is out of range, or the table needs more memory than the machine has.
    """

    resolutions: Tensor

    def __init__(
        self,
        resolutions: tuple[tuple[int, ...], ...],
        features_per_group: int,
        axes: tuple[tuple[tuple[int, ...], ...], ...] | None = None,
        sparse: bool = False,
        resizable: bool = False,
        opening: float = 0.0,
    ) -> None:
        super().__init__()
        self.resizable = resizable
        self.layout = PlanesLayout.build(resolutions, axes)
        self.dims, self.num_features = self.layout.dims, self.layout.num_groups * features_per_group
        self.register_buffer("resolutions", torch.tensor(resolutions))
        # As in section 4.1 of K-Planes: products start neither at 0 nor at 1, and factors of time at 1.
        self.table = nn.Parameter(table(self.layout.num_entries, features_per_group).uniform_(0.1, 0.5))
        with torch.no_grad():
            for group, factors in enumerate(self.layout.axes):
                for index, along in enumerate(factors):
                    if 3 in along:
                        self.layout.factor(self.table, group, index).fill_(1)
        self.optimised = Optimised("tables", sparse=True) if sparse else None
        self.deferred = PlanesGradient(self.layout) if sparse else None
        self.opening = OpenLevels(self.layout.num_groups, 1, opening) if opening else None

    def forward(self, positions: Tensor) -> Tensor:
        """Return the features (N, G * F) at `positions` (N, D) in [0, 1]."""
        if self.opening is None or self.opening.complete:
            return self._look_up(positions, self.table, self.layout)
        layout = self.layout.first(self.opening.count)
        features = self._look_up(positions, self.table[: layout.num_entries], layout)
        return self.opening.completed(features, self.num_features)

    def _look_up(self, positions: Tensor, table: Tensor, layout: PlanesLayout) -> Tensor:
        if self.deferred is not None:
            self.deferred.layout = layout
        return planes(positions, table, layout, self.deferred)

    @property
    def all_factors(self) -> list[tuple[int, int]]:
        """The group, and the index in the group, of every factor."""
        return [(group, index) for group, along in enumerate(self.layout.axes) for index in range(len(along))]

    def bands(self, factors: Sequence[tuple[int, int]], whole: Container[int] = ()) -> list[Tensor]:
        """Return a random band of consecutive rows of each of several factors, for regularisers.

        Reading all of a large table in every step would be slow. A band may extend beyond the factor, where it is cut
        off, so that all rows are equally likely. On a device that runs ahead of Python, the device draws the start of
        the band and shifts it to lie inside the factor, so that its size is constant.

        Args:
            factors: group, and index in the group, of each factor.
            whole: axes; factors along any of them are returned in full.

        Returns:
            (B, vertices along the first axis, F) values of each factor; B is at most 1/16 of the rows, or 2.
        """
        if devices.runs_ahead(self.table.device):
            return self._drawn_there(factors, whole)
        return plane_bands(self.table, self.layout, self._drawn(factors, whole), self.deferred)

    def variation(self, factors: Sequence[tuple[int, int]]) -> Tensor:
        """Return the total variation of a random band of each of K factors: (K,), summed over both axes.

        Args:
            factors: group, and index in the group, of each factor; bands are drawn as in `bands`.
        """
        if devices.runs_ahead(self.table.device):
            return variation(self._drawn_there(factors, ()))
        return band_variation(self.table, self.layout, self._drawn(factors, ()), self.deferred)

    def _drawn(self, factors: Sequence[tuple[int, int]], whole: Container[int]) -> list[Band]:
        """Draw a band of each factor on the host."""
        chosen = []
        for group, index in factors:
            height = self.layout.shape(group, index)[0]
            if any(axis in whole for axis in self.layout.axes[group][index]):
                chosen.append((group, index, 0, height))
                continue
            rows = max(height // BANDS, 2)
            first = int(torch.randint(1 - rows, height, ()))
            first, last = max(first, 0), min(first + rows, height)
            chosen.append((group, index, first, last - first))
        return chosen

    def _drawn_there(self, factors: Sequence[tuple[int, int]], whole: Container[int]) -> list[Tensor]:
        """Let the device draw a band of each factor."""
        sizes = []
        for group, index in factors:
            height = self.layout.shape(group, index)[0]
            entire = any(axis in whole for axis in self.layout.axes[group][index])
            sizes.append((group, index, height if entire else min(max(height // BANDS, 2), height)))
        return drawn_bands(self.table, self.layout, sizes)

    @torch.no_grad()
    def resample(self, resolutions: tuple[tuple[int, ...], ...], lower: Tensor, upper: Tensor) -> None:
        """Change the resolutions and the covered part of space.

        Factors are interpolated linearly, so that the features at the new vertices stay the same. The optimiser's state
        is reset if the size of the table changes.

        Args:
            resolutions: vertices along each axis of the new factors, per group.
            lower: (D,) lower corner of the new region, relative to the present unit cube.
            upper: (D,) upper corner of the new region, relative to the present unit cube.
        """
        before, old = self.layout, self.table.data
        self._relayout(torch.tensor(resolutions))
        for group, factors in enumerate(self.layout.axes):
            for index, along in enumerate(factors):
                values = before.factor(old, group, index)
                for dim, axis in zip((1, 0), along, strict=False):
                    ends = lower[axis].item(), upper[axis].item()
                    values = _interpolated(values, dim, *ends, resolutions[group][axis])
                self.layout.factor(self.table, group, index).copy_(values)

    def _relayout(self, resolutions: Tensor) -> None:
        sizes = tuple(tuple(group) for group in resolutions.tolist())
        self.layout = PlanesLayout.build(sizes, self.layout.axes)
        self.resolutions = resolutions.to(self.resolutions)
        self.table.data = table(self.layout.num_entries, self.table.shape[1], like=self.table)
        if self.deferred is not None:
            self.deferred.relayout(self.layout)

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *rest: Any) -> None:
        saved = state_dict.get(prefix + "resolutions")
        if self.resizable and saved is not None and saved.shape == self.resolutions.shape:
            self._relayout(saved)
        super()._load_from_state_dict(state_dict, prefix, *rest)


def _interpolated(values: Tensor, dim: int, first: float, last: float, count: int) -> Tensor:
    """Interpolate along `dim`, which spans [0, 1], at `count` evenly spaced positions from `first` to `last`."""
    size = values.shape[dim]
    scaled = torch.linspace(first, last, count, device=values.device).clamp(0, 1) * (size - 1)
    left = scaled.long().clamp(max=size - 2)
    shape = [-1 if d == dim else 1 for d in range(values.ndim)]
    return torch.lerp(values.index_select(dim, left), values.index_select(dim, left + 1), (scaled - left).view(shape))
