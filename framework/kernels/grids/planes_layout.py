"""The layout of factorised features: planes and lines, and the positions of their entries in one table."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import combinations
from typing import Any

from torch import Tensor

from nerfloom.base.errors import ConfigError, shown
from nerfloom.kernels import native

MAX_GROUPS, MAX_FACTORS = 64, 6
"""Maximum number of groups, and of factors of a group."""
MAX_VERTICES = 2**20
"""Maximum number of vertices along an axis; float32 then has 4 bits left for the position between two vertices."""


@dataclass(frozen=True)
class PlanesLayout:
    """Axes, resolution and entries of each factor, in one table (E, F) shared by all factors.

    Raises:
        ConfigError: if the numbers are inconsistent or out of range; the kernels rely on them.
    """

    resolutions: tuple[tuple[int, ...], ...]
    """Vertices along each of the D axes, for each of the G groups."""
    axes: tuple[tuple[tuple[int, ...], ...], ...]
    """The axis or two axes of each factor, per group. The index along the first axis varies fastest."""
    offsets: tuple[tuple[int, ...], ...]
    """Index of the first entry of each factor, per group."""
    num_entries: int
    """Number E of entries of all factors."""

    def __post_init__(self) -> None:
        _check_factors(self.resolutions, self.axes)
        for sizes, group, firsts in zip(self.resolutions, self.axes, self.offsets, strict=True):
            for along, first in zip(group, firsts, strict=True):
                last = first + math.prod(sizes[axis] for axis in along)
                if not 0 <= first < last <= self.num_entries:
                    raise ConfigError(f"planes with {self.num_entries} entries have no entries {first} to {last}")

    @classmethod
    def build(
        cls, resolutions: tuple[tuple[int, ...], ...], axes: tuple[tuple[tuple[int, ...], ...], ...] | None = None
    ) -> PlanesLayout:
        """Return the layout of factors, one after the other in the table.

        Args:
            resolutions: vertices along each of the D axes, for each of the G groups.
            axes: the axis or two axes of each factor, per group; a plane for every pair of axes if None.

        Raises:
            ConfigError: if an axis has less than 2 or more than MAX_VERTICES vertices, or the groups differ in their
                number of axes or factors.
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

    def first(self, count: int) -> PlanesLayout:
        """Return the layout of the first `count` groups, 1 or more; their entries come first in the table."""
        return _first(self, count)

    @property
    def dims(self) -> int:
        """Number D of axes."""
        return len(self.resolutions[0])

    @property
    def num_groups(self) -> int:
        """Number G of groups."""
        return len(self.resolutions)

    def shape(self, group: int, index: int) -> tuple[int, int]:
        """Return the vertices along the second axis (1 for a line) and the first axis of factor `index` of `group`."""
        sizes = [self.resolutions[group][axis] for axis in self.axes[group][index]]
        return (sizes[1] if len(sizes) == 2 else 1), sizes[0]

    def factor(self, table: Tensor, group: int, index: int) -> Tensor:
        """Return a view of a factor's entries.

        Args:
            table: (E, F) entries of all factors.
            group: index of the group.
            index: index of the factor in the group.

        Returns:
            (vertices along the second axis, or 1, vertices along the first axis, F) entries.
        """
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


@lru_cache(maxsize=64)
def _first(layout: PlanesLayout, count: int) -> PlanesLayout:
    end = layout.num_entries if count == layout.num_groups else layout.offsets[count][0]
    return PlanesLayout(layout.resolutions[:count], layout.axes[:count], layout.offsets[:count], end)


def _check_factors(resolutions: tuple[tuple[int, ...], ...], axes: tuple[tuple[tuple[int, ...], ...], ...]) -> None:
    """Check vertices and axes, which the kernels rely on; raise ConfigError if they are invalid."""
    dims = {len(scale) for scale in resolutions}
    if len(dims) != 1 or not dims <= {2, 3, 4} or len(resolutions) > MAX_GROUPS:
        groups = f"{len(resolutions)} groups of {sorted(dims)} axes"
        raise ConfigError(f"planes need 1 to {MAX_GROUPS} groups of the same 2 to 4 axes, not {groups}")
    for size in (size for scale in resolutions for size in scale):
        if not isinstance(size, int) or not 2 <= size <= MAX_VERTICES:
            raise ConfigError(f"planes need 2 to {MAX_VERTICES} vertices along each axis, not {shown(size)}")
    (count,) = dims
    numbers = {len(group) for group in axes}
    if len(axes) != len(resolutions) or len(numbers) != 1 or not numbers <= set(range(1, MAX_FACTORS + 1)):
        raise ConfigError(f"planes need 1 to {MAX_FACTORS} factors, as many in every group, not {shown(axes)}")
    for along in (along for group in axes for along in group):
        if len(along) not in (1, 2) or len(set(along)) != len(along) or not set(along) <= set(range(count)):
            raise ConfigError(f"planes need one or two of the axes 0 to {count - 1} for each factor, not {along}")
