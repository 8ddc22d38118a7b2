"""The surface where values on a lattice change their sign, by marching cubes in blocks.

Lorensen and Cline 1987, with the cases of Lewiner et al. 2003 as scikit-image has them. Each block is marched alone, so
that no more than one block of values is in memory, and blocks without a surface need not be looked at. Vertices on
the faces between blocks are found in both; each vertex is identified by the lattice edge that it lies on, and is kept
once, so that the surface has no seams.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nerfloom.base.errors import ConfigError
from nerfloom.export.lattice import Lattice

MIN_VALUE = 1e-3
"""Minimum distance of a value from 0. A vertex is then never on a lattice point, so that its edge is known, and no
triangle has lost its area."""
MAX_VERTICES = 40_000_000
"""Maximum number of vertices, which take some 3 GB; noise has more."""


def isosurface(lattice: Lattice, edge: int, blocks: Iterable[tuple[Tensor, Tensor]]) -> tuple[Tensor, Tensor]:
    """Return the surface between positive and negative values.

    It has a hole where a cell has an unknown corner.

    Args:
        lattice: where values are taken.
        edge: cells along an edge of a block.
        blocks: the blocks that are searched: index (3,), and values (N,) in [-1, 1] at its points in the order of
            `Lattice.block_points`, positive inside, NaN where nothing is known.

    Returns:
        vertices (V, 3) float64 in lattice coordinates, and faces (F, 3) int64, counterclockwise seen from outside.

    Raises:
        ConfigError: if there are more than `MAX_VERTICES` vertices.
    """
    keys: list[np.ndarray] = []
    places: list[np.ndarray] = []
    faces: list[np.ndarray] = []
    count = 0
    for block, values in blocks:
        points, shape = lattice.block_points(block, edge)
        found = _marched(values.view(shape).numpy())
        if found is None:
            continue
        vertices, triangles = found
        key, place = _identified(vertices, points[0].numpy(), lattice.cells)
        keys.append(key)
        places.append(place)
        faces.append(triangles.astype(np.int64) + count)
        count += len(vertices)
        if count > MAX_VERTICES:
            raise ConfigError(
                f"the surface has more than {MAX_VERTICES:,} vertices: it is noise, or --resolution is too high "
                "for it; take a lower --resolution, a smaller box, or another --isosurface-threshold"
            )
    if not faces:
        return torch.zeros(0, 3, dtype=torch.float64), torch.zeros(0, 3, dtype=torch.int64)
    _, first, owner = np.unique(np.concatenate(keys), return_index=True, return_inverse=True)
    vertices = np.concatenate(places)[first].astype(np.float64)
    return torch.from_numpy(vertices), torch.from_numpy(owner.reshape(-1)[np.concatenate(faces)])


def _marched(values: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Return vertices (V, 3), relative to the block, and faces (F, 3) of one block; None if it has no surface."""
    from skimage.measure import marching_cubes

    unknown = np.isnan(values)
    any_unknown = bool(unknown.any())
    filled = np.where(unknown, np.float32(-1), values).astype(np.float32)
    np.copyto(filled, np.copysign(np.float32(MIN_VALUE), filled), where=np.abs(filled) < MIN_VALUE)
    if not filled.min() < 0 < filled.max():
        return None
    function: Any = marching_cubes
    vertices, faces, _, _ = function(filled, 0.0, gradient_direction="ascent", allow_degenerate=True)
    if any_unknown:
        last = np.array(values.shape) - 2  # of a triangle in the block's last face, where no cell begins
        cells = np.minimum(np.floor(vertices[faces].mean(1)).astype(np.int64), last)
        faces = faces[~_beside(unknown)[tuple(cells.T)]]
        used, faces = np.unique(faces, return_inverse=True)
        vertices, faces = vertices[used], faces.reshape(-1, 3)
    return None if not len(faces) else (vertices, faces)


def _beside(unknown: np.ndarray) -> np.ndarray:
    """Return whether any corner of each cell is `unknown` (x, y, z)."""
    for axis in range(3):
        low, high = (np.take(unknown, range(start, unknown.shape[axis] - 1 + start), axis) for start in (0, 1))
        unknown = low | high
    return unknown


def _identified(vertices: np.ndarray, start: np.ndarray, cells: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return a number (V,) for the lattice edge, or the cell, that each vertex lies on, and its lattice coordinates."""
    nearest = np.round(vertices)
    on_point = np.abs(vertices - nearest) < MIN_VALUE / 4
    corner = np.where(on_point, nearest, np.floor(vertices)).astype(np.int64) + start
    # A vertex on an edge has one fractional coordinate; the one inside a cell, if any, has three.
    within = (~on_point).sum(1) != 1
    kind = np.where(within, 3, np.argmin(on_point, axis=1))
    key = ((corner[:, 0] * (cells[1] + 1) + corner[:, 1]) * (cells[2] + 1) + corner[:, 2]) * 4 + kind
    return key, (np.where(on_point, nearest, vertices) + start).astype(np.float32)
