"""Octrees in files of limited size: harmonics of a smaller degree first, then larger cells, then fewer leaves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from torch import Tensor

from nerfloom.base.errors import ConfigError
from nerfloom.cameras.cameras import Cameras
from nerfloom.export.octree_colors import Seen, fitted_colors, leaf_colors, seen_leaves
from nerfloom.kernels.octree.light import raw_of
from nerfloom.octrees.coarser import halved
from nerfloom.octrees.octree import Octree
from nerfloom.octrees.packing import packed

MIN_WEIGHT = 0.005
"""Leaves with a smaller largest weight on training rays are left out."""
BITS = 6
"""Number of bits of a value in a baked file. Compression removes the others of a byte."""
COMPRESSED = 0.85 - (8 - BITS) / 8
"""Expected size of a file, relative to its leaves' bytes."""
DEGREES = (2, 1, 0)
"""Degrees of harmonics to choose from, best first."""
FULL_SHARE = {3: 0.9, 2: 0.9, 1: 0.7, 0: 0.0}
"""Share of the visible leaves that must fit into the file with each degree; otherwise a smaller degree is chosen."""
MIN_SHARE = 0.5
"""Share of the visible leaves that must fit with the smallest degree; otherwise cells are too small for the file."""


def visible_leaves(largest: Tensor) -> Tensor:
    """Return the indices (V,) int64 of the leaves that images see, by the `largest` weight (L,) of each leaf."""
    return (largest > MIN_WEIGHT).nonzero()[:, 0]


def is_too_fine(largest: Tensor, max_bytes: float, degrees: Sequence[int]) -> bool:
    """Return whether a file has room for fewer than `MIN_SHARE` of the visible leaves.

    Args:
        largest: (L,) largest weight of each leaf.
        max_bytes: maximum size of the file.
        degrees: degrees of harmonics to choose from, best first.
    """
    return room_for(max_bytes, degrees[-1]) < MIN_SHARE * len(visible_leaves(largest))


def chosen(largest: Tensor, max_bytes: float, degrees: Sequence[int]) -> tuple[int, Tensor]:
    """Return the degree of harmonics, and the leaves (N,) int64 that fit, in order: the ones with the largest weights.

    Args:
        largest: (L,) largest weight of each leaf.
        max_bytes: maximum size of the file.
        degrees: degrees of harmonics to choose from, best first.

    Raises:
        ConfigError: if no leaf is visible, or fits.
    """
    visible = visible_leaves(largest)
    if not len(visible):
        raise ConfigError("no training image sees matter in the octree's box; is the run trained?")
    for degree in degrees:
        room = room_for(max_bytes, degree)
        if room >= FULL_SHARE[degree] * len(visible) or degree == degrees[-1]:
            break
    if room < 1:
        raise ConfigError(f"no leaf of an octree fits into {max_bytes / 1e6:g} MB; give --max-megabytes 1 or more")
    if room < len(visible):
        visible = visible[largest[visible].topk(room).indices].sort().values
    return degree, visible


def room_for(max_bytes: float, degree: int) -> int:
    """Return the number of leaves with harmonics of a `degree` that fit into a file of `max_bytes`."""
    return max(int(max_bytes / (COMPRESSED * (1 + 3 * (degree + 1) ** 2))), 0)


def fitted_octree(
    octree: Octree, cameras: Cameras, max_bytes: float, encode: Callable[[Octree], bytes]
) -> tuple[bytes, Octree, str]:
    """Return the file of an octree, of limited size.

    Args:
        octree: the octree, on the CPU.
        cameras: M cameras, also on the CPU; matter that they see is kept.
        max_bytes: maximum size of the file.
        encode: function that returns the content of the file.

    Returns:
        The content, the octree in it, and a description of the removed parts; empty for none.

    Raises:
        ConfigError: if no leaf is visible, or fits.
    """
    content = encode(octree)
    if len(content) <= max_bytes:
        return content, octree, ""
    degrees, coarser = range(octree.degree, -1, -1), octree
    seen = _seen(coarser, cameras)
    while is_too_fine(seen.largest, max_bytes, degrees) and max(coarser.layout.size) > 1:
        coarser = halved(coarser)
        seen = _seen(coarser, cameras)
    limit = max_bytes
    while True:
        degree, kept = chosen(seen.largest, limit, degrees)
        found = _reduced(coarser, seen, degree, kept)
        content = encode(found)
        if len(content) <= max_bytes:
            return content, found, _changes(octree, coarser, found)
        limit *= 0.98 * max_bytes / len(content)


def _seen(octree: Octree, cameras: Cameras) -> Seen:
    return seen_leaves(octree.layout, raw_of(octree.leaves.depths())[:, None], cameras, 0.0, octree.far)


def _reduced(octree: Octree, seen: Seen, degree: int, kept: Tensor) -> Octree:
    """Return some leaves (N,) of an octree, in order, with harmonics of a degree."""
    part = octree.part(kept)
    if degree == octree.degree:
        return part
    coefficients = fitted_colors(leaf_colors(part.leaves), part.layout.centers(), seen.part(kept), degree)
    return replace(part, leaves=packed(part.leaves.depths(), coefficients, BITS)[0])


def _changes(given: Octree, coarser: Octree, found: Octree) -> str:
    parts = []
    if found.degree < given.degree:
        parts.append(f"harmonics of degree {found.degree} instead of {given.degree}")
    if coarser.layout.cell > given.layout.cell:
        parts.append(f"cells of {coarser.layout.cell / given.layout.cell:.0f} times the edge")
    if found.layout.num_leaves < coarser.layout.num_leaves:
        parts.append(f"the {found.layout.num_leaves:,} most visible of {coarser.layout.num_leaves:,} leaves")
    return ", ".join(parts)
