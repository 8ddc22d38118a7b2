"""A march is given as much room as the steps before have needed.

A device that runs ahead of Python notes how much room each step would have needed. When the device is waited for
anyway, these numbers are read, and decide on the room of the steps that follow. It changes only where it has become too
small or far too large, so that most steps have the same sizes.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

HEADROOM = 1.3
"""Room that is given, in units of the most that a step since the last reading has needed."""
LEAST, MOST = 1.08, 2.0
"""Room, in the same units, below which more is given, and above which less is."""
PIECE, LIMIT = 256, 2**21
"""Numbers of slots are multiples of the former, and at most the latter."""
MOST_KEPT = 4
"""Maximum number of kept samples, in units of the number that a step should have."""


class Sizes(NamedTuple):
    """Numbers of slots."""

    runs: int
    """For runs of steps near an occupied cell."""
    candidates: int
    """For steps in occupied cells, whose density is evaluated."""
    kept: int
    """For those that light reaches."""


class Room:
    """The room of the steps of a march.

    Args:
        runs: largest number of runs of steps that a ray can have.
        steps: largest number of steps that a ray can have.
    """

    def __init__(self, runs: int, steps: int) -> None:
        self.per_ray: tuple[float, float, float] = float(runs), float(steps), float(steps)
        """Numbers of slots for each ray."""
        self.rays = self.left_out = 0
        """Number of rays so far, and of those that were left out, as last read."""
        self._needed: Tensor | None = None
        self._counted: Tensor | None = None

    def of(self, rays: int, usual: int | None = None) -> Sizes:
        """Return the numbers of slots for some rays.

        Args:
            rays: number of rays.
            usual: number of samples that a step should have, which bounds those that are kept, as before anything is
                known of a run that goes on; None for no bound but `LIMIT`.
        """
        runs, candidates, kept = (min(PIECE * math.ceil(each * rays / PIECE), LIMIT) for each in self.per_ray)
        return Sizes(runs, candidates, kept if usual is None else min(kept, MOST_KEPT * max(usual, PIECE)))

    def note(self, rays: int, needed: tuple[Tensor, Tensor, Tensor], left_out: Tensor) -> None:
        """Note on the device what a step has needed, without a wait.

        Args:
            rays: number of rays.
            needed: numbers () of runs, of candidates and of kept samples.
            left_out: () number of rays that were left out.
        """
        per_ray = torch.stack(needed).float() / rays
        if self._needed is None or self._counted is None or self._needed.device != per_ray.device:
            self._needed, self._counted = torch.zeros_like(per_ray), left_out.new_zeros(2)
        self._needed.copy_(torch.maximum(self._needed, per_ray))
        self._counted[0].add_(rays)
        self._counted[1].add_(left_out)

    def read(self) -> None:
        """Read what steps have needed since the last time, and decide on the room of those that follow."""
        if self._needed is None or self._counted is None:
            return
        *needed, rays, left_out = torch.cat([self._needed, self._counted.float()]).tolist()  # no device lacks float32
        if rays == 0:
            return
        self.per_ray = tuple(map(_enough, self.per_ray, needed))  # type: ignore[assignment]
        self.rays, self.left_out = self.rays + int(rays), self.left_out + int(left_out)
        self._needed.zero_()
        self._counted.zero_()


def _enough(given: float, needed: float) -> float:
    """Return the room of a ray for what one has `needed`: that which is `given` if it suits."""
    least = max(needed, 1.0)  # where nothing is found, something may be in the next step
    return given if LEAST * least <= given <= MOST * least else HEADROOM * least
