"""Gaussians in compressed PLY files, as SuperSplat and PlayCanvas's splat-transform write them.

The format is specified by https://github.com/playcanvas/splat-transform (src/lib/readers/decompress-ply.ts). A binary
PLY file has an element `chunk` with a row for each 256 Gaussians, the least and the most of each number in them; an
element `vertex` with four 32-bit words a Gaussian; and, for harmonics of degree 1 and higher, an element `sh` of bytes:

    packed_position   11, 10 and 11 bits of x, y and z, from the highest, between min_x ... and max_x ...
    packed_scale      likewise of the logarithms of the scales, between min_scale_x ... and max_scale_x ...
    packed_rotation   2 bits: which of w, x, y, z is largest; 10 bits of each other: 1023 (q / sqrt(2) + 1/2)
    packed_color      8 bits each of red, green, blue and opacity; between min_r ... and max_r ..., else 0 and 1
    f_rest_k          256 (f / 8 + 1/2), rounded down; 0 and 255 stand for -4 and 4

Colours are 0.5 + DC f of the coefficient f of degree 0. f_rest has the same order as in other PLY files.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from nerfloom.base.errors import DataError
from nerfloom.data.ply import PlyElement, PlyHeader, read_columns
from nerfloom.kernels.splats.project import DC, DEGREES
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.smallest_three import joined
from nerfloom.splats.stored import as_float32, logits_of_bytes

CHUNK = 256
"""Gaussians in a chunk."""
_WORDS = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_BOUNDS = [[f"{end}_{axis}" for axis in "xyz"] for end in ("min", "max", "min_scale", "max_scale")]
_COLORS = [[f"{end}_{channel}" for channel in "rgb"] for end in ("min", "max")]


def is_compressed(header: PlyHeader) -> bool:
    """Return whether a PLY file has packed Gaussians.

    Args:
        header: its header.
    """
    return "vertex" in header.elements and _WORDS[0] in header.elements["vertex"].names


def read_compressed(file: Path, header: PlyHeader) -> Gaussians:
    """Read Gaussians from a compressed PLY file. Values may be infinite or NaN.

    Args:
        file: path of the file.
        header: its header, which `is_compressed` accepts.

    Raises:
        DataError: if the file cannot be read, is truncated, or its elements do not fit each other.
    """
    vertex, chunk = header.elements["vertex"], header.elements.get("chunk")
    if chunk is None or chunk.count * CHUNK < vertex.count or chunk.order == "ascii":
        raise DataError(
            f"{file} is a compressed PLY file with {0 if chunk is None else chunk.count} chunks of"
            f" {CHUNK} for {vertex.count:,} Gaussians, or is not a binary file; export it again"
        )
    position, rotation, scale, color = (word.astype("<u4") for word in _columns(file, vertex, _WORDS, "u4"))
    rows = np.arange(len(position)) // CHUNK  # the header's count is not believed before the words are read
    low, high, low_scale, high_scale = (np.stack(_columns(file, chunk, names, "f4"), -1)[rows] for names in _BOUNDS)
    shade = np.stack([color >> shift & 255 for shift in (24, 16, 8)], -1) / 255
    if set(_COLORS[0]) <= set(chunk.names):
        darkest, brightest = (np.stack(_columns(file, chunk, names, "f4"), -1)[rows] for names in _COLORS)
        shade = _between(darkest, brightest, shade)
    return Gaussians(
        means=as_float32(_between(low, high, _three(position))),
        log_scales=as_float32(_between(low_scale, high_scale, _three(scale))),
        rotations=as_float32(_quaternions(rotation)),
        logits=logits_of_bytes(color & 255),
        colors=as_float32((shade - 0.5) / DC),
        harmonics=_harmonics(file, header, vertex.count),
    )


def _columns(file: Path, element: PlyElement, names: Sequence[str], kind: str) -> list[np.ndarray]:
    """Return columns of one numpy type."""
    kinds = dict(element.columns)
    if missing := [name for name in names if kinds.get(name) != kind]:
        raise DataError(f"{file} is a compressed PLY file without {', '.join(missing)} of its type: export it again")
    return read_columns(file, element, names)


def _three(words: np.ndarray) -> np.ndarray:
    """Return the three numbers (N, 3) from 0 to 1 in words of 11, 10 and 11 bits."""
    return np.stack([(words >> 21 & 2047) / 2047, (words >> 11 & 1023) / 1023, (words & 2047) / 2047], -1)


def _between(low: np.ndarray, high: np.ndarray, share: np.ndarray) -> np.ndarray:
    with np.errstate(over="ignore", invalid="ignore"):  # values that are not finite are removed later
        return low.astype(np.float64) * (1 - share) + high.astype(np.float64) * share


def _quaternions(words: np.ndarray) -> np.ndarray:
    """Return unit quaternions (N, 4) w, x, y, z."""
    others = np.stack([words >> shift & 1023 for shift in (20, 10, 0)], -1) / 1023 - 0.5
    return joined(words >> 30, math.sqrt(2) * others)


def _harmonics(file: Path, header: PlyHeader, count: int) -> Tensor:
    element = header.elements.get("sh")
    if element is None or not element.columns:
        return torch.zeros(count, 3, 0)
    width = len(element.columns)
    if width not in (3 * terms for terms in DEGREES.values()) or element.count != count:
        raise DataError(
            f"{file} is a compressed PLY file with {width} bytes of harmonics for {element.count:,} of {count:,}"
            " Gaussians; there must be 9, 24 or 45 for each: export it again"
        )
    bytes_ = _columns(file, element, [f"f_rest_{index}" for index in range(width)], "u1")
    stored = np.stack(bytes_, -1).astype(np.float64)
    shares = np.where(stored == 0, 0, np.where(stored == 255, 1, (stored + 0.5) / 256))
    return as_float32(8 * (shares - 0.5)).reshape(count, 3, width // 3)
