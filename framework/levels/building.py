"""Building of a tree of Gaussians from a stream, out of core: the memory depends on settings, not on the stream.

The stream is read twice: for a sample of its centres, and for the buckets (`buckets.py`). Buckets are halved down to
chunks, the leaves. Each node above has the Gaussians of two nodes, halved in number (`merging.halved`). A node is
written as soon as it is complete. Only Gaussians of nodes that wait for a neighbour are in memory, at most one of each
level.
"""

from __future__ import annotations

import math
import tempfile
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
import torch
from torch import Tensor

from nerfloom.base.atomic import write_atomically
from nerfloom.base.console import track, track_bytes
from nerfloom.base.errors import DataError, FlagError
from nerfloom.geometry.local_origin import local_origin
from nerfloom.kernels.splats.project import DEGREES
from nerfloom.levels.buckets import Buckets, drawable, of_rows
from nerfloom.levels.files import MAX_NODES, Bits, LevelsWriter, row_size
from nerfloom.levels.merging import halved
from nerfloom.levels.on_image import reaches
from nerfloom.splats.gaussians import MAX_DEGREE, Gaussians
from nerfloom.splats.stream import GaussianStream

MIN_CHUNK, MAX_CHUNK = 16, 2**20
"""Range of the maximum number of Gaussians in a chunk."""
SAMPLE = 2**16
"""Number of centres that divide space into buckets."""
MAX_ROWS = 2**17
"""Maximum number of Gaussians that are read from the stream at a time."""
COPIES = 8
"""Memory for building, in sizes of a full bucket: halving a bucket copies it, and the rest is for chunks."""
WAITING = 32
"""Minimum memory for building, in sizes of a chunk: one chunk of each level waits, and merging makes copies of two."""
MOST_NODES = 6
"""Maximum number of nodes for the Gaussians of a full chunk. A leaf is at least half full, unless it is a bucket; there
are at most as many buckets as full chunks, and fewer nodes above leaves than leaves."""


class Survey(NamedTuple):
    """The result of the first reading of a stream."""

    drawable: int
    """Number of Gaussians that can be drawn."""
    left_out: int
    """Number of Gaussians that cannot be drawn."""
    degree: int
    """Highest degree of their harmonics."""
    sample: Tensor
    """(S, 3) float64 centres of a random sample."""


def build_levels(file: Path, stream: GaussianStream, origin: Tensor, chunk_size: int, bits: Bits, memory: float) -> int:
    """Write a file of levels, and return the number of Gaussians that are left out, because they cannot be drawn.

    Args:
        file: path of the file.
        stream: the Gaussians.
        origin: (3,) float64 origin of their coordinates in the frame of the input. The file has another, if float32 is
            too coarse for these coordinates.
        chunk_size: maximum number of Gaussians in a chunk.
        bits: bits of each number but the centres.
        memory: maximum memory for Gaussians, MB (1e6 bytes), besides the stream's.

    Raises:
        FlagError: if the chunk size or the memory is out of range, or too small for the Gaussians.
        DataError: if no Gaussian can be drawn, or the stream cannot be read.
        OSError: if a file cannot be written.
    """
    if not MIN_CHUNK <= chunk_size <= MAX_CHUNK:
        raise FlagError(f"--chunk-size is {chunk_size}; it must be from {MIN_CHUNK} to {MAX_CHUNK:,}")
    if not 0 < memory < math.inf:
        raise FlagError(f"--build-memory is {memory:g}; it must be more than 0 and finite, in MB")
    found = survey(stream, rows_at_once(memory))
    if not found.drawable:
        raise DataError("there are no Gaussians to write, or none of them can be drawn; export or crop them again")
    if chunk_size < (smallest := math.ceil(MOST_NODES * found.drawable / MAX_NODES)):
        raise FlagError(f"--chunk-size is {chunk_size}; {found.drawable:,} Gaussians need at least {smallest:,}")
    row = row_size(found.degree, 32)
    if not memory >= (least := WAITING * chunk_size * row / 1e6):
        raise FlagError(f"--build-memory is {memory:g}; chunks of {chunk_size:,} Gaussians need at least {least:g} MB")
    local = local_origin(found.sample)
    shift = torch.zeros(3, dtype=torch.float64) if local is None else local
    with tempfile.TemporaryDirectory(prefix=f".{file.name}.", dir=file.parent) as folder:
        sample = (found.sample - shift).float().numpy()
        buckets = Buckets(Path(folder), sample, found.drawable, found.degree, int(memory * 1e6 / (COPIES * row)))
        buckets.fill(stream, shift, rows_at_once(memory))

        def write(out: BinaryIO) -> None:
            writer = LevelsWriter(out, found.degree, bits)
            _Tree(writer, chunk_size).grow(buckets)
            writer.finish(origin + shift, stream.look)

        write_atomically(file, write)
    return found.left_out


def rows_at_once(memory: float) -> int:
    """Return the number of Gaussians that are read at a time if building may take `memory`, MB (1e6 bytes)."""
    return int(min(max(memory * 1e6 / (2 * COPIES * row_size(MAX_DEGREE, 32)), 1), MAX_ROWS))


def survey(stream: GaussianStream, rows: int) -> Survey:
    """Read a `stream` once, `rows` at a time: count its Gaussians, and choose a random sample of their centres."""
    random = torch.Generator().manual_seed(0)
    total = count = terms = 0
    keys, sample = torch.zeros(0), torch.zeros(0, 3, dtype=torch.float64)
    with track_bytes("Reading the Gaussians", None) as advance:
        for given in stream.parts(rows):
            part = given[drawable(given)]
            total, count, terms = total + len(given), count + len(part), max(terms, part.harmonics.shape[2])
            keys = torch.cat([keys, torch.rand(len(part), generator=random)])
            sample = torch.cat([sample, part.means.double()])
            kept = keys.topk(min(SAMPLE, len(keys)), largest=False).indices
            keys, sample = keys[kept], sample[kept]
            advance(len(given) * row_size(given.degree, 32))
    return Survey(count, total - count, {terms: degree for degree, terms in DEGREES.items()}[terms], sample)


class _Node(NamedTuple):
    """A written node, with the values that the node above it needs."""

    number: int
    gaussians: Gaussians
    errors: Tensor
    low: Tensor
    high: Tensor
    reach: float


class _Tree:
    """The tree that is being written."""

    def __init__(self, writer: LevelsWriter, chunk_size: int) -> None:
        self.writer, self.chunk_size = writer, chunk_size

    def grow(self, buckets: Buckets) -> None:
        """Write the nodes of all buckets and those above them."""
        waiting: list[tuple[int, _Node | None]] = []  # heights above the buckets, and nodes
        for index in track(range(len(buckets)), "Merging", len(buckets)):
            node: _Node | None = None
            for rows in buckets.taken(index):
                node = self.joined(node, self.halves(rows))
            height = 0
            while waiting and waiting[-1][0] == height:
                node = self.joined(waiting.pop()[1], node)
                height += 1
            waiting.append((height, node))

    def halves(self, rows: np.ndarray) -> _Node:
        """Write the nodes of rows (n, width) of Gaussians, and return the highest."""
        if len(rows) <= self.chunk_size:
            return self.node(of_rows(rows), torch.zeros(len(rows)))
        axis, half = int(np.ptp(rows[:, :3], axis=0).argmax()), len(rows) // 2
        order = np.argpartition(rows[:, axis], half)
        node = self.joined(self.halves(rows[order[:half]]), self.halves(rows[order[half:]]))
        assert node is not None
        return node

    def joined(self, first: _Node | None, second: _Node | None) -> _Node | None:
        """Write the node above two nodes, and return it; return a single node as it is."""
        if first is None or second is None:
            return first or second
        gaussians = Gaussians.joined([first.gaussians, second.gaussians])
        return self.node(*halved(gaussians, torch.cat([first.errors, second.errors])), first, second)

    def node(self, gaussians: Gaussians, errors: Tensor, *below: _Node) -> _Node:
        """Write a node of Gaussians, with their errors, above its children, and return it."""
        centers = gaussians.means.double()
        low = torch.stack([centers.amin(0), *(node.low for node in below)]).amin(0)
        high = torch.stack([centers.amax(0), *(node.high for node in below)]).amax(0)
        reach = max(float(reaches(gaussians.logits, gaussians.log_scales).max()), *(node.reach for node in below), 0.0)
        error, children = float(errors.max()), [node.number for node in below]
        index = self.writer.add(gaussians, children, low, high, reach, error)
        return _Node(index, gaussians, errors, low, high, reach)
