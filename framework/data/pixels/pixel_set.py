"""Sets of a data set's pixels, stored as runs: the size depends on a region's outline, not on its area."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from nerfloom.geometry.records import TensorRecord


@dataclass(frozen=True)
class PixelSet(TensorRecord):
    """N runs of consecutive pixels, numbered over all images: K pixels in ascending order."""

    starts: Tensor
    """(N,) int64 first pixel of each run, ascending."""
    before: Tensor
    """(N + 1,) int64 number of pixels in the runs before each run; the last entry is K."""
    every: Tensor | None = None
    """(K,) all pixels, if memory suffices; drawing from this list is four times as fast."""

    @classmethod
    def of_runs(cls, starts: Tensor, lengths: Tensor) -> PixelSet:
        """Construct from runs of `lengths` (N,) from `starts` (N,) int64, ascending, neither overlapping nor empty."""
        return cls(starts, torch.cat([torch.zeros_like(starts[:1]), lengths]).cumsum(0) if len(starts) else _none(1))

    @classmethod
    def of_mask(cls, mask: Tensor, first: int = 0) -> PixelSet:
        """Construct from the true elements of a bool `mask`, of any shape, that begins at pixel `first`."""
        edges = torch.nn.functional.pad(mask.reshape(-1).to(torch.int8), (1, 1)).diff()
        starts = (edges == 1).nonzero().squeeze(-1)
        return cls.of_runs(starts + first, (edges == -1).nonzero().squeeze(-1) - starts)

    @classmethod
    def joined(cls, sets: Iterable[PixelSet]) -> PixelSet:
        """Concatenate `sets`; each lies behind the one before."""
        pairs = [(part.starts, part.before.diff()) for part in sets]
        starts, lengths = (torch.cat(column) for column in zip(*pairs, strict=True))
        return cls.of_runs(starts, lengths)

    @classmethod
    def shared(cls, sets: Sequence[PixelSet], at_least: int) -> PixelSet:
        """Return the pixels that are in at least `at_least` of the `sets`: 1 for the union."""
        starts = torch.cat([part.starts for part in sets])
        ends = torch.cat([part.starts + part.before.diff() for part in sets])
        boundaries, order = torch.cat([ends, starts]).sort(stable=True)  # at equal positions, ends before starts
        depth = torch.where(order < len(ends), -1, 1).cumsum(0)
        inside = torch.zeros_like(boundaries, dtype=torch.bool)
        inside[:-1] = (depth[:-1] >= at_least) & (boundaries.diff() > 0)
        first, last = boundaries[inside], boundaries[1:][inside[:-1]]
        opens, closes = torch.ones_like(first, dtype=torch.bool), torch.ones_like(first, dtype=torch.bool)
        opens[1:] = first[1:] != last[:-1]  # adjacent intervals form one run
        closes[:-1] = opens[1:]
        return cls.of_runs(first[opens], last[closes] - first[opens])

    def __len__(self) -> int:
        return self._count

    @cached_property
    def _count(self) -> int:
        return int(self.before[-1])

    @cached_property
    def _ends(self) -> Tensor:
        """(N + 1,) first pixel after the run before each run; 0 before the first."""
        return torch.cat([torch.zeros_like(self.before[:1]), self.starts + self.before.diff()])

    def listed(self) -> PixelSet:
        """Return the set with all pixels listed in `every`."""
        every = self.pixels()
        small = len(every) == 0 or int(every[-1]) < 2**31
        return replace(self, every=every.to(torch.int32) if small else every)

    def at(self, ranks: Tensor) -> Tensor:
        """Return the pixels (R,) int64 of given `ranks` (R,) in the set, counted from 0."""
        if self.every is not None:
            return self.every.index_select(0, ranks).long()
        if ranks.device.type == "cpu":  # numpy takes one thread; a background thread must not start PyTorch's
            return torch.from_numpy(self._at(ranks.numpy()))
        runs = torch.searchsorted(self.before, ranks, right=True) - 1
        return self.starts[runs] + ranks - self.before[runs]

    def _at(self, ranks: np.ndarray) -> np.ndarray:
        starts, before = self.starts.numpy(), self.before.numpy()
        runs = np.searchsorted(before, ranks, side="right") - 1
        return starts[runs] + (ranks - before[runs])

    def ranks(self, pixels: Tensor) -> Tensor:
        """Return the number of pixels of the set before each of the `pixels` (R,) int64, (R,) int64."""
        runs = (torch.searchsorted(self.starts, pixels, right=True) - 1).clamp(min=0)
        into = (pixels - self.starts[runs]).clamp(min=0)
        return torch.minimum(self.before[runs] + into, self.before[runs + 1])

    def contains(self, pixels: Tensor) -> Tensor:
        """Return whether the set contains each of the `pixels` (R,) int64, (R,) bool."""
        return pixels < self._ends[torch.searchsorted(self.starts, pixels, right=True)]

    def pixels(self) -> Tensor:
        """Return all pixels, (K,) int64."""
        shift = (self.starts - self.before[:-1]).repeat_interleave(self.before.diff())
        return shift.add_(torch.arange(len(self), device=self.starts.device))

    def mask(self, first: int, last: int) -> Tensor:
        """Return whether the set contains each pixel from `first` to `last` - 1, (last - first,) bool."""
        ends = self.starts + self.before.diff()
        low = int(torch.searchsorted(ends, first, right=True))
        high = int(torch.searchsorted(self.starts, last))
        steps = torch.zeros(last - first + 1, dtype=torch.int32, device=self.starts.device)
        steps[(self.starts[low:high] - first).clamp(min=0)] += 1
        steps[(ends[low:high] - first).clamp(max=last - first)] -= 1
        return steps[:-1].cumsum(0) > 0


def _none(count: int) -> Tensor:
    return torch.zeros(count, dtype=torch.int64)
