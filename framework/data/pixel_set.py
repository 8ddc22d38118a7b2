"""Some of a data set's pixels, kept as runs: what is cut out of photographs costs its outline, not its area."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor


@dataclass(frozen=True)
class PixelSet:
    """N runs of neighbouring pixels, counted through all images; K pixels in all, in ascending order."""

    starts: Tensor
    """(N,) int64 first pixel of each run, ascending."""
    before: Tensor
    """(N + 1,) int64 how many pixels lie in the runs before each; the last is K."""
    every: Tensor | None = None
    """(K,) the pixels one by one, where there is memory for them: four times as fast to draw from."""

    @classmethod
    def of_runs(cls, starts: Tensor, lengths: Tensor) -> PixelSet:
        """Runs that are in order, and neither overlap nor are empty."""
        return cls(starts, torch.cat([torch.zeros_like(starts[:1]), lengths]).cumsum(0) if len(starts) else _none(1))

    @classmethod
    def of_mask(cls, mask: Tensor, first: int = 0) -> PixelSet:
        """Where `mask` (of any shape) is true, its first element being pixel `first`."""
        edges = torch.nn.functional.pad(mask.reshape(-1).to(torch.int8), (1, 1)).diff()
        starts = (edges == 1).nonzero().squeeze(-1)
        return cls.of_runs(starts + first, (edges == -1).nonzero().squeeze(-1) - starts)

    @classmethod
    def of_pixels(cls, pixels: Tensor) -> PixelSet:
        """The pixels (K,), ascending."""
        first = torch.ones(len(pixels), dtype=torch.bool, device=pixels.device)
        first[1:] = pixels.diff() > 1
        ends = torch.cat([first.nonzero().squeeze(-1), torch.tensor([len(pixels)], device=pixels.device)])
        return cls.of_runs(pixels[first], ends.diff())

    @classmethod
    def joined(cls, sets: Iterable[PixelSet]) -> PixelSet:
        """All of some sets that follow each other."""
        pairs = [(part.starts, part.before.diff()) for part in sets]
        starts, lengths = (torch.cat(column) for column in zip(*pairs, strict=True))
        return cls.of_runs(starts, lengths)

    @classmethod
    def shared(cls, sets: Sequence[PixelSet], at_least: int) -> PixelSet:
        """Pixels that lie in at least so many of the sets: 1 is their union, the number of sets what all share."""
        starts = torch.cat([part.starts for part in sets])
        ends = torch.cat([part.starts + part.before.diff() for part in sets])
        places, order = torch.cat([ends, starts]).sort(stable=True)  # of a run's end and another's start, the end first
        depth = torch.where(order < len(ends), -1, 1).cumsum(0)
        within = torch.zeros_like(places, dtype=torch.bool)
        within[:-1] = (depth[:-1] >= at_least) & (places.diff() > 0)
        first, last = places[within], places[1:][within[:-1]]
        opens, closes = torch.ones_like(first, dtype=torch.bool), torch.ones_like(first, dtype=torch.bool)
        opens[1:] = first[1:] != last[:-1]  # pieces that touch are one run
        closes[:-1] = opens[1:]
        return cls.of_runs(first[opens], last[closes] - first[opens])

    def __len__(self) -> int:
        return self._count

    @cached_property
    def _count(self) -> int:
        return int(self.before[-1])

    @cached_property
    def _ends(self) -> Tensor:
        """(N + 1,) where the run before each begins to be over; 0 before the first."""
        return torch.cat([torch.zeros_like(self.before[:1]), self.starts + self.before.diff()])

    def to(self, device: torch.device | str) -> PixelSet:
        """The same pixels on `device`."""
        known = (getattr(self, f.name) for f in fields(self))
        return PixelSet(*(None if values is None else values.to(device) for values in known))  # type: ignore[arg-type]

    def listed(self) -> PixelSet:
        """The same pixels, which are also kept one by one."""
        every = self.pixels()
        small = len(every) == 0 or int(every[-1]) < 2**31
        return replace(self, every=every.to(torch.int32) if small else every)

    def at(self, ranks: Tensor) -> Tensor:
        """(R,) int64 the pixels that are the `ranks`-th (R,) of the set, from 0."""
        if self.every is not None:
            return self.every[ranks].long()
        if ranks.device.type == "cpu":  # numpy takes one thread: a background thread must not wake torch's
            return torch.from_numpy(self._at(ranks.numpy()))
        runs = torch.searchsorted(self.before, ranks, right=True) - 1
        return self.starts[runs] + ranks - self.before[runs]

    def _at(self, ranks: np.ndarray) -> np.ndarray:
        starts, before = self.starts.numpy(), self.before.numpy()
        runs = np.searchsorted(before, ranks, side="right") - 1
        return starts[runs] + (ranks - before[runs])

    def contains(self, pixels: Tensor) -> Tensor:
        """(R,) bool: which of the pixels (R,) int64 are in the set."""
        return pixels < self._ends[torch.searchsorted(self.starts, pixels, right=True)]

    def pixels(self) -> Tensor:
        """(K,) int64 all of them."""
        shift = (self.starts - self.before[:-1]).repeat_interleave(self.before.diff())
        return shift.add_(torch.arange(len(self), device=self.starts.device))

    def mask(self, first: int, last: int) -> Tensor:
        """(last - first,) bool: which of the pixels first .. last - 1 are in the set."""
        ends = self.starts + self.before.diff()
        low = int(torch.searchsorted(ends, first, right=True))
        high = int(torch.searchsorted(self.starts, last))
        steps = torch.zeros(last - first + 1, dtype=torch.int32, device=self.starts.device)
        steps[(self.starts[low:high] - first).clamp(min=0)] += 1
        steps[(ends[low:high] - first).clamp(max=last - first)] -= 1
        return steps[:-1].cumsum(0) > 0


def _none(count: int) -> Tensor:
    return torch.zeros(count, dtype=torch.int64)
