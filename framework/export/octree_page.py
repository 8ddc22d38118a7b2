"""Web pages of octrees: the scene in the form that the page's program (`page/octree.js`) reads.

The data are compressed by gzip. Numbers are little endian:

    0     b"OCT1"
    4     uint32     degree of the harmonics; bricks along x, y and z; bricks with leaves, B; leaves, L
    28    float32    corner of the first cell, x, y, z; edge of a cell; transmittance where rays end; rotation from
                     the octree's axes to the page's, row by row
    84    float32    256 optical depths of a cell's edge; 3 K scales; 3 K offsets
          uint64     (B, 8) leaves of each octant (`kernels/octree/layout.py`)
          uint8      (X, Y, Z) distance from each brick to the nearest one with leaves, in bricks; 0 for those
          uint8      (L) codes
          uint8      (3 K, L) colours, by coefficient, which compresses better than by leaf
"""

from __future__ import annotations

import gzip
import struct

import numpy as np
from torch import Tensor

from nerfloom.cameras.cameras import Cameras
from nerfloom.export.octree_size import fitted_octree
from nerfloom.export.web import PageFacts, page, room
from nerfloom.octrees.drawn import DrawnOctree
from nerfloom.octrees.octree import Octree

MAGIC = b"OCT1"
"""First bytes of the data."""
LEVEL = 6
"""Level of compression."""


def make_octree_page(
    octree: Octree, turn: Tensor, cameras: Cameras, facts: PageFacts, max_megabytes: float
) -> tuple[str, Octree, list[str]]:
    """Return a web page of an octree of limited size.

    Args:
        octree: the octree, on the CPU.
        turn: (3, 3) rotation from the octree's frame to the page's, where z is up.
        cameras: M cameras in the octree's frame, on the CPU; matter that they see is kept.
        facts: further data of the page, in its frame.
        max_megabytes: maximum size of the page, in millions of bytes.

    Returns:
        The page, the octree in it, and sentences about parts removed to fit it.

    Raises:
        ConfigError: if the limit is above MAX_MEGABYTES, or no leaf fits.
    """
    payload, found, changes = fitted_octree(
        octree, cameras, room(facts, max_megabytes), lambda some: octree_payload(some, turn)
    )
    return page(payload, facts), found, [f"{max_megabytes:g} MB hold {changes}"] if changes else []


def octree_payload(octree: Octree, turn: Tensor) -> bytes:
    """Return the data of a page.

    Args:
        octree: the octree, on the CPU.
        turn: (3, 3) rotation from the octree's frame to the page's.
    """
    layout, leaves, drawn = octree.layout, octree.leaves, DrawnOctree(octree, octree.scene)
    counts = octree.degree, *layout.size, len(layout.masks), layout.num_leaves
    limit = drawn.early_stop / drawn.largest
    numbers = *layout.origin.tolist(), layout.cell, limit, *turn.flatten().tolist()
    arrays = [
        *(values.numpy().astype("<f4") for values in (leaves.table, leaves.scales, leaves.offsets)),
        layout.masks.numpy().astype("<i8"),
        layout.bricks.clamp(max=0).neg().numpy().astype(np.uint8),
        leaves.codes.numpy(),
        leaves.colors.numpy().T,
    ]
    head = struct.pack("<4s6I14f", MAGIC, *counts, *numbers)
    return gzip.compress(head + b"".join(array.tobytes() for array in arrays), LEVEL, mtime=0)
