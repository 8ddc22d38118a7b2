"""Division of a stream of Gaussians into files of neighbouring Gaussians, each small enough for memory.

A sample of the centres gives the cells of a kd-tree, which is halved at the median across the longest side of a cell's
points. A bucket has the Gaussians of a cell.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from nerfloom.base.console import track_bytes
from nerfloom.kernels.splats.project import DEGREES
from nerfloom.splats.gaussians import COLUMNS, Gaussians
from nerfloom.splats.stream import GaussianStream

WIDTHS = (3, 3, 4, 1, 3)
"""Numbers of a Gaussian in a row before the harmonics: mean, log scales, rotation, logit and colour."""
LARGEST = 1e18
"""Largest coordinate and standard deviation of a Gaussian. The squares of lengths are then finite in float32."""


def drawable(gaussians: Gaussians) -> Tensor:
    """Return (N,) whether N `gaussians` can be drawn, with float32 centres, and merged."""
    near = (gaussians.means.abs() <= LARGEST).all(1) & (gaussians.log_scales <= math.log(LARGEST)).all(1)
    return gaussians.drawable() & near


class Buckets:
    """Files of rows, float32, one Gaussian each, in the order of the leaves of a kd-tree.

    Args:
        folder: an empty folder for the files.
        sample: (S, 3) float32 centres of some Gaussians; S is at least 1.
        count: number of all Gaussians.
        degree: highest degree of their harmonics.
        most: maximum number of Gaussians in memory.
    """

    def __init__(self, folder: Path, sample: np.ndarray, count: int, degree: int, most: int) -> None:
        self.folder, self.count, self.degree, self.most = folder, count, degree, most
        # Half of `most` on average, because medians of a sample differ from medians of all.
        self.depth = (-(-2 * count // most) - 1).bit_length()
        self.axes, self.values = splits(sample, self.depth)

    def __len__(self) -> int:
        return 2**self.depth

    @property
    def width(self) -> int:
        """Number of numbers in a row."""
        return sum(WIDTHS) + 3 * DEGREES[self.degree]

    def fill(self, stream: GaussianStream, shift: Tensor, rows: int) -> None:
        """Write all drawable Gaussians of a stream to the files.

        Args:
            stream: the Gaussians.
            shift: (3,) float64 point that becomes the origin.
            rows: maximum number of Gaussians that are read at a time.

        Raises:
            OSError: if a file cannot be written.
        """
        with track_bytes("Dividing the Gaussians", 4 * self.width * self.count) as advance:
            for part in stream.parts(rows):
                table = as_rows(part[drawable(part)], shift, DEGREES[self.degree])
                buckets = bucket_of(table[:, :3], self.axes, self.values)
                table = table[buckets.argsort(kind="stable")]
                ends = np.bincount(buckets, minlength=len(self)).cumsum()
                for index in np.unique(buckets).tolist():
                    with self._file(index).open("ab") as file:
                        file.write(table[ends[index - 1] if index else 0 : ends[index]].tobytes())
                advance(table.nbytes)

    def taken(self, index: int) -> Iterator[np.ndarray]:
        """Yield the rows (n, width) of the bucket `index`, and remove its file.

        All rows are yielded at once, unless the bucket is too large. A bucket is too large if very many Gaussians are
        at one place, where no plane can separate them.
        """
        file = self._file(index)
        if not file.exists():
            return
        with file.open("rb") as stream:
            while len(values := np.fromfile(stream, np.float32, self.most * self.width)):
                yield values.reshape(-1, self.width)
        file.unlink()

    def _file(self, index: int) -> Path:
        return self.folder / f"{index}.bucket"


def splits(points: np.ndarray, depth: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the planes of a kd-tree: axes and positions (2^depth - 1,), a cell's two halves at 2 i + 1 and 2 i + 2.

    Args:
        points: (S, 3) positions.
        depth: number of times that space is halved.
    """
    axes, values = np.zeros(2**depth - 1, np.int64), np.zeros(2**depth - 1, np.float32)
    cells = [points]
    for index in range(len(axes)):
        cell, cells[index] = cells[index], points[:0]  # the cell itself is not needed below
        if len(cell):
            axes[index] = np.ptp(cell, axis=0).argmax()
            values[index] = np.median(cell[:, axes[index]])
        beyond = cell[:, axes[index]] > values[index]
        cells += [cell[~beyond], cell[beyond]]
    return axes, values


def bucket_of(points: np.ndarray, axes: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the index (N,) int64 of the cell of `axes` and `values`, from `splits`, for each of `points` (N, 3)."""
    cells, rows = np.zeros(len(points), np.int64), np.arange(len(points))
    for _ in range(len(axes).bit_length()):
        cells = 2 * cells + 1 + (points[rows, axes[cells]] > values[cells])
    return cells - len(axes)


def as_rows(gaussians: Gaussians, shift: Tensor, terms: int) -> np.ndarray:
    """Return Gaussians as rows (N, width) float32.

    Args:
        gaussians: N Gaussians on the CPU.
        shift: (3,) float64 point that becomes the origin.
        terms: coefficients of degrees 1 and higher for each channel; missing ones are 0.
    """
    g = gaussians
    harmonics = pad(g.harmonics, (0, terms - g.harmonics.shape[2])).flatten(1)
    means = (g.means.double() - shift).float()
    return torch.cat([means, g.log_scales, g.rotations, g.logits[:, None], g.colors, harmonics], 1).numpy()


def of_rows(rows: np.ndarray) -> Gaussians:
    """Return the Gaussians in `rows` (N, width) float32; most columns share their memory."""
    parts = torch.from_numpy(rows).split([*WIDTHS, rows.shape[1] - sum(WIDTHS)], dim=1)
    columns = dict(zip(COLUMNS, parts, strict=True))
    columns["logits"] = columns["logits"][:, 0]
    columns["harmonics"] = columns["harmonics"].reshape(len(rows), 3, (rows.shape[1] - sum(WIDTHS)) // 3)
    return Gaussians.of(columns)
