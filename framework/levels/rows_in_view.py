"""The Gaussians that an image may show, as rows of tables in files, for training and pictures with a memory limit.

A chunk is a number of consecutive rows. Rows are sorted along a curve through space, so a chunk's Gaussians are near
each other. Each chunk has a box of their centres, which is computed again after a training step has changed them.
"""

from __future__ import annotations

import torch
from torch import Tensor

from nerfloom.base.console import say
from nerfloom.kernels.splats.project import SplatCamera
from nerfloom.kernels.table_memory import Tables
from nerfloom.levels.nodes import Boxes
from nerfloom.levels.on_image import in_view, reaches
from nerfloom.splats.table import Columns

CHUNK = 1024
"""Number of rows of a chunk."""
MEASURED = 2**18
"""Maximum number of rows in a computation of boxes."""
STEP_SIZE = 256
"""Memory of a Gaussian in a step besides its parameters and their gradient, bytes: its record and the gradient of that,
its entries in lists of tiles, and parameters after their activation."""
NEWS = 1.5
"""Minimum ratio of the memory of a step to the last reported one for a new report."""


class RowsInView:
    """The rows of tables that images may show, and the memory that these rows take.

    Args:
        tables: place of the tables; their memory can be released.
        limit: memory for the rows of a step, and for rows of earlier steps, bytes.
        chunk: number of rows of a chunk.
    """

    def __init__(self, tables: Tables, limit: float, chunk: int = CHUNK) -> None:
        self.tables, self.limit, self.chunk = tables, limit, chunk
        self.boxes: Boxes | None = None
        """Boxes of the chunks; None if rows have been added, dropped or sorted since they were computed."""
        self._stale = self._mapped = torch.zeros(0, dtype=torch.bool)  # of each chunk
        self._version, self._reported = 0, 0.0

    def forget(self) -> None:
        """Forget all boxes, because rows are added, dropped or sorted."""
        self.boxes = None

    @torch.no_grad()
    def of(self, columns: Columns, extent: Tensor, camera: SplatCamera, directions: Tensor, learns: bool) -> Tensor:
        """Return the rows (K,) int64 of the Gaussians that an image may show, ascending.

        If these rows and the rows in memory would exceed the limit, the memory of all rows is released. If these rows
        alone exceed it, a line says so.

        Args:
            columns: all N Gaussians.
            extent: size () of the scene, scene units.
            camera: the camera in the frame of the scene.
            directions: (2, 2) range of the directions of the image (`on_image.tangents`).
            learns: whether a training step follows, which changes these rows.
        """
        count = len(columns["means"].values)
        seen = in_view(self._measured(columns, extent), camera, directions)
        rows = self._rows(seen.nonzero()[:, 0])
        rows = rows[rows < count]
        self._make_room(columns, seen, len(rows), learns)
        if learns:
            self._stale |= seen
        return rows

    def _rows(self, chunks: Tensor) -> Tensor:
        """Return the rows of chunks, also those beyond the last Gaussian."""
        return (self.chunk * chunks[:, None] + torch.arange(self.chunk)).flatten()

    def _measured(self, columns: Columns, extent: Tensor) -> Boxes:
        """Return the boxes of all chunks, after computing all that are missing or may have changed."""
        values = columns["means"].values
        everything = self.boxes is None or values._version != self._version  # which a loaded checkpoint changes
        if self.boxes is None or everything:
            chunks = -(-len(values) // self.chunk)
            corners = torch.zeros(2, chunks, 3, dtype=torch.float64)
            self.boxes = Boxes(corners[0], corners[1], torch.zeros(chunks, dtype=torch.float64))
            self._stale = torch.ones(chunks, dtype=torch.bool)
            self._mapped = torch.zeros(chunks, dtype=torch.bool)
            self._version = values._version
        low, high, reach = self.boxes
        for some in self._stale.nonzero()[:, 0].split(max(MEASURED // self.chunk, 1)):
            rows = self._rows(some).clamp(max=len(values) - 1)  # the last Gaussian fills up the last chunk
            means, logits, log_scales = (columns[name].read(extent, rows) for name in ("means", "logits", "log_scales"))
            # Gaussians that are not finite are not drawn. It is at the origin here, so that it hides no other Gaussian.
            centers = means.nan_to_num(nan=0.0).double().view(len(some), self.chunk, 3)
            low[some], high[some] = centers.amin(1), centers.amax(1)
            reach[some] = reaches(logits, log_scales).nan_to_num(nan=0.0).view(len(some), self.chunk).amax(1)
            if everything:
                self.tables.release()
        self._stale.zero_()
        return self.boxes

    def _make_room(self, columns: Columns, seen: Tensor, rows: int, learns: bool) -> None:
        """Release memory before a step on `rows` rows of the chunks `seen`, if necessary."""
        numbers = sum(column.values.shape[1] for column in columns.values())
        stored = 4 * (3 * numbers + len(columns)) if learns else 4 * numbers  # with two moments, and counts of updates
        working = 4 * numbers * (2 if learns else 1) + STEP_SIZE
        self._mapped |= seen
        if int(self._mapped.sum()) * self.chunk * stored + rows * working > self.limit:
            self.tables.release()
            self._mapped = seen.clone()
        needed = rows * (stored + working)
        if needed > max(self.limit, NEWS * self._reported):
            say(
                f"--memory-limit {self.limit / 1e6:g} MB: an image may show {rows:,} Gaussians, which take "
                f"{needed / 1e6:,.0f} MB; the limit is exceeded"
            )
            self._reported = needed
