"""Files of Gaussians in a tree of levels, NAME.levels: plain arrays, which numpy can map, and a header in JSON.

    64 bytes               b"NLEVELS1"; position and length of the header, uint64 each; its SHA-256; 8 zeros
    chunks                 one of each node, each filled up with zeros to a multiple of 64 bytes:
        means              (n, 3) float32 centres, relative to the origin
        log_scales         (n, 3)
        rotations          (n, 4) quaternions w, x, y, z
        logits             (n,)
        colors             (n, 3)
        harmonics          (n, 3, K)
    header                 to the end of the file: UTF-8, an object

All but the means are float32 or float16, by `bits`; all numbers are little endian. The header has

    version, degree, bits  1; degree of the harmonics, K = (degree + 1)^2 - 1 in number; 32 or 16
    origin                 x, y, z in the frame of the input
    look                   antialiased, blur, sort: the settings of drawing
    count, crc32           of each node: its number of Gaussians, and the CRC-32 of its chunk without the zeros
    parent                 index of the node above it, which comes later; -1 for the root, the last node
    low, high              of each node: corners of a box of the centres of its Gaussians and of those below
    reach, error           of each node: `levels/nodes.py`

The positions of all chunks follow from these numbers. They are compared with the size of the file before any chunk is
read. A chunk is read into memory and then used, instead of being mapped: if another process truncated a mapped file,
drawing would end this one.
"""

from __future__ import annotations

import hashlib
import json
import os
import struct
import zlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any, BinaryIO, Literal

import numpy as np
import torch
from torch import Tensor

from nerfloom.base.checked import checked
from nerfloom.base.errors import DataError, one_line
from nerfloom.kernels.splats.project import DEGREES
from nerfloom.levels.nodes import Nodes
from nerfloom.splats.gaussians import COLUMNS, Gaussians
from nerfloom.splats.look import MAX_BLUR, MIN_BLUR, Look

SUFFIX = ".levels"
"""Suffix of the files."""
VERSION = 1
"""Version of the format."""
MAGIC = b"NLEVELS1"
"""Beginning of a file."""
PREAMBLE = struct.Struct("<8sQQ32s8x")
"""The beginning, position and length of the header, and its SHA-256."""
ALIGNMENT = 64
"""Positions of chunks are multiples of this number of bytes."""
MAX_HEADER = 2**26
"""Maximum length of a header, bytes. The header of 50 million Gaussians in chunks of 50,000 has about 0.5 MB."""
MAX_NODES = 2**18
"""Maximum number of nodes that are written. A header has at most 250 bytes for each."""
LARGEST_HALF = 65504.0
"""Largest float16."""
Bits = Literal[16, 32]
"""Bits of each number but the centres."""


@dataclass(frozen=True)
class LevelsFile:
    """An open file of levels, with its chunks on disk."""

    path: Path
    """The file."""
    nodes: Nodes
    """Its nodes; node i has the chunk i."""
    degree: int
    """Degree of the harmonics, 0 to 3."""
    bits: Bits
    """Bits of each number but the centres."""
    origin: Tensor
    """(3,) float64 origin of the file's coordinates in the frame of the input."""
    look: Look
    """The settings of drawing."""
    starts: Sequence[int]
    """Position of each chunk in the file, and last of the header, bytes."""
    checksums: Sequence[int]
    """CRC-32 of each chunk."""

    @property
    def num_gaussians(self) -> int:
        """Number of Gaussians of the scene, which are in the leaves."""
        return int(self.nodes.counts[self.nodes.is_leaf].sum())

    @property
    def gaussian_size(self) -> int:
        """Size of a Gaussian in memory, where all numbers are float32, bytes."""
        return 4 * sum(_widths(self.degree).values())

    def read(self, index: int) -> Gaussians:
        """Read the Gaussians of the node `index`, float32.

        Raises:
            DataError: if the file cannot be read, or has changed or is damaged at this place.
        """
        count = int(self.nodes.counts[index])
        length = count * row_size(self.degree, self.bits)
        try:
            with self.path.open("rb") as stream:
                content = np.fromfile(stream, np.uint8, length, offset=self.starts[index])
        except OSError as error:
            raise DataError(f"cannot read {self.path}: {error.strerror or error}") from error
        if len(content) < length or zlib.crc32(content.data) != self.checksums[index]:
            raise DataError(
                f"{self.path}: chunk {index} is damaged, or the file has changed since it was opened; open it again, or"
                " copy or export it again"
            )
        columns: dict[str, Tensor] = {}
        place = 0
        for name, width in _widths(self.degree).items():
            kind = _kind(name, self.bits)
            end = place + count * width * kind.itemsize
            columns[name] = torch.from_numpy(content[place:end].view(kind).astype(np.float32)).view(count, width)
            place = end
        columns["logits"] = columns["logits"][:, 0]
        columns["harmonics"] = columns["harmonics"].view(count, 3, DEGREES[self.degree])
        return Gaussians.of(columns)


class LevelsWriter:
    """Writes the chunks of a file. The nodes below a node are written before it.

    Args:
        stream: a new binary file, which can be sought.
        degree: degree of the harmonics.
        bits: bits of each number but the centres.
    """

    def __init__(self, stream: BinaryIO, degree: int, bits: Bits) -> None:
        self.stream, self.degree, self.bits = stream, degree, bits
        self._header: dict[str, list[Any]] = {
            name: [] for name in ("count", "crc32", "parent", "low", "high", "reach", "error")
        }
        stream.write(bytes(PREAMBLE.size))

    def add(
        self, gaussians: Gaussians, children: Sequence[int], low: Tensor, high: Tensor, reach: float, error: float
    ) -> int:
        """Write the chunk of a node, and return the node's index.

        Args:
            gaussians: its Gaussians on the CPU, without further columns, with harmonics of the file's degree.
            children: indices of the nodes directly below.
            low, high: (3,) corners of its box.
            reach: maximum distance from its centre where a Gaussian is drawn.
            error: largest standard deviation of a merged Gaussian.
        """
        stored = gaussians if self.bits == 32 else _for_half(gaussians)
        arrays = [getattr(stored, name).numpy().astype(_kind(name, self.bits)) for name in COLUMNS]
        content = b"".join(array.tobytes() for array in arrays)
        self.stream.write(content + bytes(-len(content) % ALIGNMENT))
        index = len(self._header["count"])
        for child in children:
            self._header["parent"][child] = index
        values = (len(gaussians), zlib.crc32(content), -1, low.tolist(), high.tolist(), reach, error)
        for column, value in zip(self._header.values(), values, strict=True):
            column.append(value)
        return index

    def finish(self, origin: Tensor, look: Look) -> None:
        """Write the header, with the `origin` (3,) of coordinates in the input's frame, and the `look` of drawing."""
        facts = {"version": VERSION, "degree": self.degree, "bits": self.bits, "origin": origin.tolist()}
        text = json.dumps({**facts, "look": asdict(look), **self._header}, separators=(",", ":"), allow_nan=False)
        content, begin = text.encode(), self.stream.tell()
        self.stream.write(content)
        self.stream.seek(0)
        self.stream.write(PREAMBLE.pack(MAGIC, begin, len(content), hashlib.sha256(content).digest()))


def is_levels_file(path: Path) -> bool:
    """Return whether `path` names a file of levels, by its suffix."""
    return path.suffix.lower() == SUFFIX


def row_size(degree: int, bits: Bits) -> int:
    """Return the bytes of a Gaussian in a file, with harmonics of `degree` and `bits` of each number but centres."""
    return sum(width * _kind(name, bits).itemsize for name, width in _widths(degree).items())


def chunk_starts(counts: Sequence[int], degree: int, bits: Bits) -> list[int]:
    """Return the positions of the chunks of `counts` Gaussians, and last of the header.

    `degree` and `bits` are as in `row_size`.

    `degree` and `bits` are as in `row_size`.
    """
    row = row_size(degree, bits)
    filled = [-(-count * row // ALIGNMENT) * ALIGNMENT for count in counts]
    return list(accumulate(filled, initial=PREAMBLE.size))


def read_levels(file: Path) -> LevelsFile:
    """Open a `file` of levels: read and check its header. Chunks are read later.

    Raises:
        DataError: if the file cannot be read, is damaged, or is something else.
    """
    try:
        header, begin = _header(file)
        return _checked(file, header, begin)
    except OSError as error:
        raise DataError(f"cannot read {file}: {error.strerror or error}") from error
    except (ValueError, LookupError, ArithmeticError, TypeError, RecursionError) as error:
        raise DataError(
            f"{file} is not a file of levels, or is damaged: {one_line(error)}; copy or export it again"
        ) from error


def _header(file: Path) -> tuple[dict[str, Any], int]:
    """Return the header of a file and its position, after checking its length and checksum."""
    with file.open("rb") as stream:
        size, start = os.fstat(stream.fileno()).st_size, stream.read(PREAMBLE.size)
        if len(start) < PREAMBLE.size:
            raise ValueError(f"it has only {size:,} bytes")
        magic, begin, length, digest = PREAMBLE.unpack(start)
        if magic != MAGIC:
            raise ValueError("it begins with other bytes")
        if begin + length != size or not 0 < length <= MAX_HEADER:
            raise ValueError(f"it has {size:,} bytes, and states a header of {length:,} bytes at {begin:,}")
        stream.seek(begin)
        content = stream.read(length)
    if hashlib.sha256(content).digest() != digest:
        raise ValueError("its header does not have the checksum that it states")
    header = json.loads(content)
    if not isinstance(header, dict):
        raise ValueError("its header is not an object")
    return header, begin


def _checked(file: Path, header: dict[str, Any], begin: int) -> LevelsFile:
    """Return the file of a header at a position; raise ValueError if they do not fit."""
    version, degree, bits = (header.get(name) for name in ("version", "degree", "bits"))
    if version != VERSION:
        raise ValueError(f"it has another version of the format than {VERSION}, the only one supported")
    if type(degree) is not int or degree not in DEGREES or type(bits) is not int or bits not in (16, 32):
        raise ValueError("its harmonics must have a degree from 0 to 3, and its numbers 16 or 32 bits")
    width: Bits = 16 if bits == 16 else 32
    look = checked(Look, header.get("look"))
    if not MIN_BLUR <= look.blur <= MAX_BLUR:
        raise ValueError(f"its blur must be from {MIN_BLUR:g} to {MAX_BLUR:g} pixels^2")
    counts = _integers(header, "count", None)
    total = len(counts)
    if not total or not (counts >= 1).all() or int(counts.max()) > begin:
        raise ValueError("each node must have Gaussians ('count'), and no more than the file has bytes")
    checksums, parents = _integers(header, "crc32", total), _integers(header, "parent", total)
    low, high = _floats(header, "low", (total, 3)), _floats(header, "high", (total, 3))
    reach, errors = _floats(header, "reach", (total,)), _floats(header, "error", (total,))
    below, above = np.arange(total - 1), parents[:-1]
    if parents[-1] != -1 or not ((above > below) & (above < total)).all():
        raise ValueError("its nodes are not a tree")
    if not ((high >= low).all() and (reach >= 0).all() and (errors >= 0).all()):
        raise ValueError("its nodes have boxes, extents or errors below zero")
    outward = np.column_stack([-low, high, reach, errors])
    if not (outward[above] >= outward[:-1]).all():
        raise ValueError("its nodes have larger boxes, extents or errors than those above them")
    nodes = Nodes(*map(torch.from_numpy, (counts, parents, low, high, reach, errors)))
    starts = chunk_starts(counts.tolist(), degree, width)
    if starts[-1] != begin:
        raise ValueError("its chunks do not end where its header begins")
    origin = torch.from_numpy(_floats(header, "origin", (3,)))
    return LevelsFile(file, nodes, degree, width, origin, look, starts, checksums.tolist())


def _widths(degree: int) -> dict[str, int]:
    """Return how many numbers of each column a Gaussian has, in the order of the file."""
    return dict(zip(COLUMNS, (3, 3, 4, 1, 3, 3 * DEGREES[degree]), strict=True))


def _kind(name: str, bits: Bits) -> np.dtype[Any]:
    """Return the type of the numbers of a column."""
    return np.dtype("<f2" if bits == 16 and name != "means" else "<f4")


def _for_half(gaussians: Gaussians) -> Gaussians:
    """Return Gaussians with their numbers clamped to the range of float16, and unit rotations."""
    rotations = torch.nn.functional.normalize(gaussians.rotations.double(), dim=-1, eps=0).float()
    limited = gaussians.map(lambda values: values.clamp(-LARGEST_HALF, LARGEST_HALF))
    return Gaussians.of({**limited.columns, "means": gaussians.means, "rotations": rotations})


def _integers(header: dict[str, Any], name: str, count: int | None) -> np.ndarray:
    """Return integers (count,) int64 of a header."""
    values = header.get(name)
    # Types are checked first, because an array of texts takes the size of the longest for each.
    integers = values if isinstance(values, list) and all(type(value) is int for value in values) else []
    if not integers or (count is not None and len(integers) != count):
        raise ValueError(f"its '{name}' must be a list of integers, one for each node")
    return _array(header, name, np.int64)


def _floats(header: dict[str, Any], name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Return finite numbers of a shape, float64, of a header."""
    values = _array(header, name, np.float64)
    if values.shape != shape or not np.isfinite(values).all():
        raise ValueError(f"its '{name}' must be finite numbers {shape}")
    return values


def _array(header: dict[str, Any], name: str, kind: type) -> np.ndarray:
    try:
        return np.array(header.get(name), kind)
    except (ValueError, TypeError, OverflowError) as error:
        raise ValueError(f"its '{name}' must be numbers") from error
