"""Capacity of the lists of Gaussians per tile, estimated from earlier images.

The number of entries is known on the device only. A device that runs ahead of Python records it for each image. These
records set the capacity for later images at the next synchronisation. Each image synchronises until the capacity for
its size is known. Entries beyond the capacity are dropped and counted.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from nerfloom.base import device as devices
from nerfloom.kernels.splats.tiles import TileLists

HEADROOM = 1.3
"""Ratio of the capacity to the maximum number of entries that an image needed."""
FADED = 0.95
"""Factor of the known maximum at each reading, unless a newer image needs more."""
ENTRIES_MULTIPLE = 4096
"""Capacities are multiples of this number of entries."""


class Capacity:
    """Capacity of lists of tiles, in entries for each Gaussian."""

    def __init__(self) -> None:
        self.entries = self.left_out = 0
        """Numbers of entries needed and dropped so far, at the last reading."""
        self._per_gaussian = 0.0
        self._pixels = 0
        self._largest = 0
        self._noted: Tensor | None = None

    def of(self, records: Tensor, pixels: int) -> int | None:
        """Return the number of entries for an image; None if it must be read from the device.

        Args:
            records: (N, RECORD) Gaussians on the image.
            pixels: number of pixels of the image.
        """
        if not devices.runs_ahead(records.device) or not len(records) or pixels > self._pixels:
            return None
        return ENTRIES_MULTIPLE * math.ceil(HEADROOM * self._per_gaussian * len(records) / ENTRIES_MULTIPLE)

    def note(self, records: Tensor, pixels: int, lists: TileLists) -> None:
        """Record on the device the number of entries that an image needed, without synchronising.

        Args:
            records: (N, RECORD) Gaussians on the image.
            pixels: number of pixels of the image.
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
        """Read the records since the last reading, and set the capacity for later images. Synchronises."""
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
