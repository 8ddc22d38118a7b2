"""Capacity of the lists of Gaussians on an image's tiles, from what earlier images needed.

Only a device that runs ahead of Python knows how many entries the lists have. It notes what each image needs. When it
is waited for anyway, the notes are read, and decide on the capacity for the images that follow. Until something is
known of images of their size, each image waits. Gaussians beyond the capacity are left out, and counted.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from nerfloom.base import device as devices
from nerfloom.kernels.splats.tiles import TileLists

HEADROOM = 1.3
"""Capacity, in units of the most that an image has needed."""
FADED = 0.95
"""What is left of the most that images have needed, at each reading, unless one needs more."""
PIECE = 4096
"""Numbers of entries are multiples of it."""


class Capacity:
    """Capacity of lists of tiles, in entries for each Gaussian."""

    def __init__(self) -> None:
        self.entries = self.left_out = 0
        """Number of entries that images have needed so far, and of those that were left out, as last read."""
        self._per_gaussian = 0.0
        self._pixels = 0
        self._largest = 0
        self._noted: Tensor | None = None

    def of(self, records: Tensor, pixels: int) -> int | None:
        """Return the number of entries for an image; None if the device is to be asked.

        Args:
            records: (N, RECORD) Gaussians on the image.
            pixels: size of the image.
        """
        if not devices.runs_ahead(records.device) or not len(records) or pixels > self._pixels:
            return None
        return PIECE * math.ceil(HEADROOM * self._per_gaussian * len(records) / PIECE)

    def note(self, records: Tensor, pixels: int, lists: TileLists) -> None:
        """Note on the device what an image has needed, without a wait.

        Args:
            records: (N, RECORD) Gaussians on the image.
            pixels: size of the image.
            lists: its lists.
        """
        if not devices.runs_ahead(records.device) or not len(records):
            return
        given = len(lists.ids)
        needed = torch.full((), given, device=records.device) if lists.needed is None else lists.needed
        self._largest = max(self._largest, pixels)
        if self._noted is None or self._noted.device != needed.device:
            self._noted = torch.zeros(3, device=needed.device)
        most, entries, left_out = self._noted.unbind()
        most.copy_(torch.maximum(most, needed / len(records)))
        entries.add_(needed)
        left_out.add_((needed - given).clamp(min=0))

    def read(self) -> None:
        """Read what images have needed since the last time, and decide on the capacity for those that follow."""
        if self._noted is None:
            return
        most, entries, left_out = self._noted.tolist()
        if entries == 0:
            return
        known = FADED * self._per_gaussian if self._largest <= self._pixels else 0.0
        self._per_gaussian, self._pixels = max(most, known), max(self._pixels, self._largest)
        self.entries, self.left_out = self.entries + int(entries), self.left_out + int(left_out)
        self._noted.zero_()
        self._largest = 0
