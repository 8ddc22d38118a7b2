"""Distances that matter may have moved since time 0."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class MotionBound:
    """Distance that matter may have moved since time 0, as a function of time.

    Between two times, matter moves at most by the difference of their distances.
    """

    times: Tensor
    """(K,) float64 increasing times, from 0 or less to 1 or more."""
    distances: Tensor
    """(K,) float64 distances at these times, scene units, not decreasing; linear in between."""

    @classmethod
    def of(cls, times: Tensor, speeds: Tensor) -> MotionBound:
        """Integrate speeds over time.

        Args:
            times: (K,) increasing times in [0, 1].
            speeds: (K,) speeds at these times, scene units per unit of time. Between two times the larger speed is
                used; before the first and after the last time, theirs.
        """
        ends = times.new_tensor([0.0, 1.0])
        knots = torch.cat([ends[:1].minimum(times[:1]), times, ends[1:].maximum(times[-1:])]).double()
        around = torch.cat([speeds[:1], speeds, speeds[-1:]]).double()
        ways = knots.diff() * torch.maximum(around[1:], around[:-1])
        return cls(knots, torch.cat([ways.new_zeros(1), ways.cumsum(0)]))

    def at(self, times: Tensor) -> Tensor:
        """Return the distances (N,) float64 at `times` (N,) in [0, 1]."""
        times = times.double()
        after = torch.searchsorted(self.times, times, right=True).clamp(1, len(self.times) - 1)
        start, end = self.times[after - 1], self.times[after]
        share = (times - start) / (end - start).clamp(min=torch.finfo(torch.float64).tiny)
        return torch.lerp(self.distances[after - 1], self.distances[after], share.clamp(0, 1))

    @property
    def fastest(self) -> float:
        """Maximum speed, scene units per unit of time."""
        spans = self.times.diff()
        return float((self.distances.diff()[spans > 0] / spans[spans > 0]).max())

    def in_a_slice(self, slices: int) -> float:
        """Return the maximum distance in one of `slices` equal parts of the time from 0 to 1, scene units."""
        return float(self.at(torch.linspace(0, 1, slices + 1)).diff().max())
