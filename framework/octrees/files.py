"""Files of octrees, NAME.octree: a .npz archive (a zip file of plain arrays), compressed.

    version                2; 1 had a single box, and no array `bricks`
    size                   (3,) bricks along each axis
    origin, cell           corner of the first cell, and a cell's edge, scene units
    bricks                 (V,) number of bricks with leaves in each of V boxes; each box has the same centre, twice the
                           edges and as many cells as the one before, and leaves out its inside
    places                 (B, 3) uint16 coordinates of the bricks, box by box, in ascending order
    masks                  (B, 8) uint64 leaves of each octant (`kernels/octree/layout.py`)
    codes, table           (L,) uint8 and (256 V,): the optical depth of a cell's edge is the table's of box and code
    colors                 (3 K, L) uint8, by coefficient, which compresses better than by leaf
    scales, offsets        (3 K,) coefficient = scale * byte + offset
    transform, scale       the input's frame to the scene's: scale * (transform @ x)
    near, far              distance from a camera where the scene starts and ends, scene units
    alpha, image_size      1 if the images have alpha; their longer side, pixels

A leaf's coefficients are K = (degree + 1)^2 harmonics of each channel, in the order of `spherical_harmonics`.
"""

from __future__ import annotations

import math
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nerfloom.base.archives import uncompressed_size
from nerfloom.base.arrays import read_small_arrays
from nerfloom.base.atomic import write_atomically
from nerfloom.base.errors import DataError, one_line
from nerfloom.cameras.poses import Placement
from nerfloom.data.scene import MAX_COORDINATE, MAX_SIZE
from nerfloom.kernels.octree.layout import BRICK, MAX_BRICKS, MAX_LEVELS, OctreeLayout, cells_of
from nerfloom.kernels.octree.light import MAX_DEGREE
from nerfloom.kernels.octree.packed import CODES, PackedLeaves
from nerfloom.octrees.octree import Octree

SUFFIX = ".octree"
"""Suffix of the files."""
VERSION = 2
"""Version of the format."""
MAX_SIDE = 2**16
"""Maximum number of bricks along an axis: their coordinates are stored in 16 bits."""
MAX_BYTES = 4e9
"""Maximum size of a file's arrays."""
MAX_RATIO = 300
"""Maximum size of the arrays, relative to the file. Real files have less than 10, and a small damaged one must not
fill the memory."""
NAMES = (
    "version", "size", "origin", "cell", "bricks", "places", "masks", "codes", "table", "colors", "scales", "offsets",
    "transform", "scale", "near", "far", "alpha", "image_size",
)  # fmt: skip
"""Names of the arrays."""


def is_octree_file(path: Path) -> bool:
    """Return whether `path` names a file of an octree, by its suffix."""
    return path.suffix.lower() == SUFFIX


def write_octree(file: Path, octree: Octree) -> None:
    """Write an octree.

    Args:
        file: path of the file.
        octree: the octree, on the CPU.

    Raises:
        OSError: if the file cannot be written.
    """
    layout, leaves, placement = octree.layout, octree.leaves, octree.placement
    arrays: dict[str, Any] = {
        "version": VERSION,
        "size": np.array(layout.size, np.int64),
        "origin": layout.origin.numpy(),
        "cell": layout.cell,
        "bricks": np.array([len(level.masks) for level in layout.levels], np.int64),
        "places": torch.cat([level.places() for level in layout.levels]).numpy().astype(np.uint16),
        "masks": torch.cat([level.masks for level in layout.levels]).numpy().view(np.uint64),
        "codes": leaves.codes.numpy(),
        "table": leaves.table.numpy(),
        "colors": np.ascontiguousarray(leaves.colors.numpy().T),
        "scales": leaves.scales.numpy(),
        "offsets": leaves.offsets.numpy(),
        "transform": placement.transform.numpy(),
        "scale": placement.scale,
        "near": octree.near,
        "far": octree.far,
        "alpha": int(octree.has_alpha),
        "image_size": octree.image_size,
    }
    write_atomically(file, lambda stream: np.savez_compressed(stream, **arrays))


def read_octree(file: Path) -> Octree:
    """Read an octree.

    Args:
        file: path of the file.

    Raises:
        DataError: if the file cannot be read, is damaged, has another version, or is something else.
    """
    try:
        arrays = _arrays(file)
        return _octree(arrays)
    except OSError as error:
        raise DataError(f"cannot read {file}: {error.strerror or error}") from error
    except (ValueError, LookupError, ArithmeticError, TypeError, zipfile.BadZipFile, zlib.error, EOFError) as error:
        raise DataError(f"{file} is not an octree, or is damaged: {one_line(error)}; copy or bake it again") from error
    except (RuntimeError, NotImplementedError, MemoryError) as error:  # encrypted, compressed in another way, too large
        raise DataError(f"{file} cannot be read as an octree: {one_line(error)}; copy or bake it again") from error


def _arrays(file: Path) -> dict[str, np.ndarray]:
    expected = uncompressed_size(file)
    if expected > min(MAX_BYTES, MAX_RATIO * file.stat().st_size):
        raise ValueError(f"it claims to hold {expected:,} bytes")
    arrays = read_small_arrays(file, NAMES.__contains__, expected)
    # The version comes first: others have other arrays.
    version = _number(arrays, "version", 0, 1e6) if "version" in arrays else VERSION
    if version != VERSION:
        raise DataError(f"{file} has version {version:g} of the format, and {VERSION} is known; bake it again")
    missing = [name for name in NAMES if name not in arrays]
    if missing:
        raise ValueError(f"it has no array '{missing[0]}'")
    return arrays


def _octree(arrays: dict[str, np.ndarray]) -> Octree:
    layout = _layout(arrays)
    leaves = _leaves(arrays, layout)
    transform = _floats(arrays, "transform", (3, 4), np.float64)
    rotation = transform[:, :3]
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) or not np.linalg.det(rotation) > 0:
        raise ValueError("its transform is not a rigid motion")
    near, far = _number(arrays, "near", 0, MAX_COORDINATE), _number(arrays, "far", 0, MAX_COORDINATE)
    if not near < far:
        raise ValueError("it ends before it starts")
    return Octree(
        layout,
        leaves,
        Placement.of(torch.from_numpy(transform), _number(arrays, "scale", 1e-9, MAX_COORDINATE)),
        near,
        far,
        _number(arrays, "alpha", 0, 1) == 1,
        int(_number(arrays, "image_size", 1, MAX_SIZE)),
    )


def _layout(arrays: dict[str, np.ndarray]) -> OctreeLayout:
    size = tuple(int(count) for count in _integers(arrays, "size", (3,), 1, MAX_SIDE))
    cell = _number(arrays, "cell", 1e-9, MAX_COORDINATE)
    origin = _floats(arrays, "origin", (3,), np.float32)
    boxes, count = len(arrays["bricks"]), len(arrays["places"])
    bricks = _integers(arrays, "bricks", (boxes,), 0, count).tolist()
    if not 1 <= boxes <= MAX_LEVELS or sum(bricks) != count:
        raise ValueError(f"it has {count:,} bricks, and {sum(bricks):,} in {boxes} boxes")
    if max(size) * BRICK * cell * 2**boxes > MAX_COORDINATE or math.prod(size) > MAX_BRICKS:
        raise ValueError("its box is too large")
    places = torch.from_numpy(_integers(arrays, "places", (count, 3), 0, MAX_SIDE - 1).astype(np.int64))
    masks = _typed(arrays, "masks", (count, 8), np.uint64)
    # Before cells are listed: a brick of 64 bytes may claim 512 of them.
    leaves, codes = int.from_bytes(masks.tobytes(), "little").bit_count(), arrays["codes"].shape
    if codes != (leaves,):
        raise ValueError(f"its masks have {leaves:,} leaves, and its array 'codes' has shape {codes}")
    levels, corner = list[OctreeLayout](), torch.from_numpy(origin)
    parts = places.split(bricks), torch.from_numpy(masks.view(np.int64)).split(bricks)
    for some, theirs in zip(*parts, strict=True):
        cells = cells_of(some, theirs)
        level, rows = OctreeLayout.build(corner, cell, size, cells)
        if not torch.equal(rows, torch.arange(len(cells))):
            raise ValueError("its bricks are not in order")
        levels.append(level)
        corner, cell = level.around(), 2 * cell
    return levels[0].within(levels[1:])


def _leaves(arrays: dict[str, np.ndarray], layout: OctreeLayout) -> PackedLeaves:
    width, count = len(arrays["scales"]), layout.num_leaves
    if width not in [3 * (degree + 1) ** 2 for degree in range(MAX_DEGREE + 1)]:
        raise ValueError(f"its leaves have {width} coefficients")
    table = _floats(arrays, "table", (CODES * len(layout.levels),), np.float32)
    if (table < 0).any():
        raise ValueError("its table has negative densities")
    colors = _typed(arrays, "colors", (width, count), np.uint8)
    return PackedLeaves(
        torch.from_numpy(_typed(arrays, "codes", (count,), np.uint8)),
        torch.from_numpy(table),
        torch.from_numpy(np.ascontiguousarray(colors.T)),
        torch.from_numpy(_floats(arrays, "scales", (width,), np.float32)),
        torch.from_numpy(_floats(arrays, "offsets", (width,), np.float32)),
    )


def _typed(arrays: dict[str, np.ndarray], name: str, shape: tuple[int, ...], kind: Any) -> np.ndarray:
    values = arrays[name]
    if values.shape != shape or values.dtype != kind:
        raise ValueError(f"its array '{name}' has shape {values.shape} and type {values.dtype}")
    return np.array(values, kind)


def _floats(arrays: dict[str, np.ndarray], name: str, shape: tuple[int, ...], kind: Any) -> np.ndarray:
    values = _typed(arrays, name, shape, kind)
    if not (np.abs(values) < MAX_COORDINATE).all():
        raise ValueError(f"its array '{name}' has a value that is not finite, or too large")
    return values


def _integers(arrays: dict[str, np.ndarray], name: str, shape: tuple[int, ...], least: int, most: int) -> np.ndarray:
    values = arrays[name]
    if values.shape != shape or values.dtype.kind not in "iu" or not ((values >= least) & (values <= most)).all():
        raise ValueError(f"its array '{name}' has another shape or type, or a value out of range")
    return values


def _number(arrays: dict[str, np.ndarray], name: str, least: float, most: float) -> float:
    values = arrays[name]
    value = float(values) if values.shape == () else math.nan
    if not least <= value <= most:
        raise ValueError(f"its '{name}' is not a number from {least:g} to {most:g}")
    return value
