"""The layout of a hash grid: resolution and entries of each level, validated on construction."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import Any

from nerfloom.base.errors import ConfigError, shown
from nerfloom.kernels import native

MAX_LEVELS = 64
"""Maximum number of levels."""
MAX_RESOLUTION = 2**20
"""Maximum number of cells along an axis; float32 then has 4 bits left for the position in a cell."""
MAX_LOG2_TABLE_SIZE = 28
"""Maximum number of entries of a level, log2, so that 32 bits can index them."""


@dataclass(frozen=True)
class HashGridLayout:
    """Resolution and entries of each of L levels, in one table (E, F) shared by all levels.

    Raises:
        ConfigError: if the numbers are inconsistent or out of range; the kernels rely on them.
    """

    resolutions: tuple[int, ...]
    """Number of cells along each axis, for each level."""
    offsets: tuple[int, ...]
    """Index of the first entry of each level, followed by the number E of all entries: L + 1 values."""

    def __post_init__(self) -> None:
        _check("levels", len(self.resolutions), MAX_LEVELS)
        if len(self.offsets) != len(self.resolutions) + 1 or self.offsets[0] != 0:
            raise ConfigError(f"a hash grid of {len(self.resolutions)} levels needs one more offset, starting at 0")
        for resolution, (first, end) in zip(self.resolutions, pairwise(self.offsets), strict=True):
            _check("cells along an axis", resolution, MAX_RESOLUTION)
            _check("entries of a level", end - first, 2**MAX_LOG2_TABLE_SIZE)
            if (resolution + 1) ** 3 > end - first and (end - first) & (end - first - 1):
                raise ConfigError(f"a hashed level of a hash grid needs a power of two of entries, not {end - first}")

    @classmethod
    def build(cls, num_levels: int, base_resolution: int, max_resolution: int, log2_table_size: int) -> HashGridLayout:
        """Return a layout with geometrically growing resolutions: equations 2 and 3.

        Args:
            num_levels: number L of levels.
            base_resolution: cells along an axis at the first level.
            max_resolution: cells along an axis at the last level.
            log2_table_size: maximum number of entries of one level, as a power of two.

        Raises:
            ConfigError: if a number is less than 1 or exceeds MAX_LEVELS, MAX_RESOLUTION or MAX_LOG2_TABLE_SIZE.
        """
        _check("levels", num_levels, MAX_LEVELS)
        _check("cells along an axis", base_resolution, MAX_RESOLUTION)
        _check("cells along an axis", max_resolution, MAX_RESOLUTION)
        _check("for log2 of a level's entries", log2_table_size, MAX_LOG2_TABLE_SIZE)
        growth = (max_resolution / base_resolution) ** (1 / max(num_levels - 1, 1))
        resolutions = tuple(int(base_resolution * growth**level + 1e-6) for level in range(num_levels))
        sizes = [min((resolution + 1) ** 3, 2**log2_table_size) for resolution in resolutions]
        offsets = [0]
        for size in sizes:
            offsets.append(offsets[-1] + (size + 7) // 8 * 8)
        return cls(resolutions, tuple(offsets))

    def first(self, count: int) -> HashGridLayout:
        """Return the layout of the first `count` levels, 1 or more; their entries come first in the table."""
        return _first(self, count)

    @property
    def num_entries(self) -> int:
        """Number E of entries of all levels."""
        return self.offsets[-1]

    @property
    def num_levels(self) -> int:
        """Number L of levels."""
        return len(self.resolutions)

    @cached_property
    def arrays(self) -> tuple[Any, Any]:
        """Resolutions and offsets as C arrays."""
        return native.integers(self.resolutions), native.integers(self.offsets)

    def is_dense(self, level: int) -> bool:
        """Return whether each vertex of `level` has its own entry."""
        return (self.resolutions[level] + 1) ** 3 <= self.offsets[level + 1] - self.offsets[level]


@lru_cache(maxsize=64)
def _first(layout: HashGridLayout, count: int) -> HashGridLayout:
    return HashGridLayout(layout.resolutions[:count], layout.offsets[: count + 1])


def _check(what: str, count: int, most: int) -> None:
    """Check that a count is an integer from 1 to `most`."""
    if not isinstance(count, int) or not 1 <= count <= most:
        raise ConfigError(f"a hash grid has 1 to {most} {what}, not {shown(count)}")
