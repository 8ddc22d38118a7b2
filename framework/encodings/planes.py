"""Feature planes and lines, with their table."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from framework.base.optimised import Optimised
from framework.kernels.memory import table
from framework.kernels.planes import PlanesGradient, PlanesLayout, plane_band, planes

BANDS = 16


class FeaturePlanes(nn.Module):
    """Factorised features over [0, 1]^D (K-Planes, section 3; TensoRF, section 4); a fourth axis is time.

    Args:
        resolutions: vertices along each axis, per group of factors.
        features_per_group: F.
        axes: each factor's axis or two axes, per group; a plane for every pair of axes if None.
        sparse: updates touch only the entries that a step used, as for `HashGrid`.
        resizable: `resample` will be called; a checkpoint may hold other resolutions.
    """

    resolutions: Tensor

    def __init__(
        self,
        resolutions: tuple[tuple[int, ...], ...],
        features_per_group: int,
        axes: tuple[tuple[tuple[int, ...], ...], ...] | None = None,
        sparse: bool = False,
        resizable: bool = False,
    ) -> None:
        super().__init__()
        self.resizable = resizable
        self.layout = PlanesLayout.build(resolutions, axes)
        self.dims, self.num_features = self.layout.dims, self.layout.num_groups * features_per_group
        self.register_buffer("resolutions", torch.tensor(resolutions))
        # As in K-Planes' section 4.1: products start neither at zero nor at one; time changes nothing at first.
        self.table = nn.Parameter(table(self.layout.num_entries, features_per_group).uniform_(0.1, 0.5))
        with torch.no_grad():
            for group, factors in enumerate(self.layout.axes):
                for index, along in enumerate(factors):
                    if 3 in along:
                        self.layout.factor(self.table, group, index).fill_(1)
        self.optimised = Optimised("tables", sparse=True) if sparse else None
        self.deferred = PlanesGradient(self.layout) if sparse else None

    def forward(self, positions: Tensor) -> Tensor:
        """Positions (N, D) in [0, 1] to features (N, G * F)."""
        return planes(positions, self.table, self.layout, self.deferred)

    def random_band(self, group: int, index: int) -> Tensor:
        """Some neighbouring rows (at most vertices / 16, along the first axis, F) of a factor, for regularisers.

        A look at all of a large table would be dear. The band may stick out of the factor, where it is cut off, so that
        every row is as likely as any other.
        """
        height, _ = self.layout.shape(group, index)
        rows = max(height // BANDS, 2)
        first = int(torch.randint(1 - rows, height, ()))
        first, last = max(first, 0), min(first + rows, height)
        return plane_band(self.table, self.layout, group, index, first, last - first, self.deferred)

    @torch.no_grad()
    def resample(self, resolutions: tuple[tuple[int, ...], ...], lower: Tensor, upper: Tensor) -> None:
        """Other resolutions, over the part of space from `lower` to `upper` (D,), in units of the present one.

        Factors are interpolated linearly, so that what is looked up stays as it was at the new vertices. The table
        becomes larger or smaller; the optimiser begins anew where its size changes.
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
    """`values` along `dim` at `count` places evenly from `first` to `last`, 0 being its start and 1 its end."""
    size = values.shape[dim]
    places = torch.linspace(first, last, count, device=values.device).clamp(0, 1) * (size - 1)
    left = places.long().clamp(max=size - 2)
    shape = [-1 if d == dim else 1 for d in range(values.ndim)]
    return torch.lerp(values.index_select(dim, left), values.index_select(dim, left + 1), (places - left).view(shape))
