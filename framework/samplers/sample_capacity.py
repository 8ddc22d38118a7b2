"""Sample-buffer capacity of a march, adapted to recent steps.

On a device that runs ahead of Python, each step records how much capacity it needed. When Python waits for the device
anyway, it reads these numbers and sets the capacity of the following steps. The capacity changes only if it has become
too small or far too large, so that most steps have the same sizes.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

HEADROOM = 1.3
"""New capacity, relative to the largest need since the last reading."""
MIN_HEADROOM, MAX_HEADROOM = 1.08, 2.0
"""The capacity grows below the first and shrinks above the second of these ratios of capacity to need."""
SLOTS_MULTIPLE, MAX_SLOTS = 256, 2**21
"""Numbers of slots are multiples of the first and at most the second."""
MAX_KEPT = 4
"""Maximum number of kept samples, relative to the target number per step."""


class Sizes(NamedTuple):
    """Numbers of slots."""

    runs: int
    """For runs of steps near an occupied cell."""
    candidates: int
    """Capacity for steps in occupied cells, where the density is evaluated."""
    kept: int
    """For steps that light reaches."""


class SampleCapacity:
    """Capacity for the steps of a march of at most `runs` runs and `steps` steps on a ray."""

    def __init__(self, runs: int, steps: int) -> None:
        self.per_ray: tuple[float, float, float] = float(runs), float(steps), float(steps)
        """Numbers of slots for each ray."""
        self.rays = self.left_out = 0
        """Numbers of rays so far and of dropped rays, as last read."""
        self._needed: Tensor | None = None
        self._counted: Tensor | None = None

    def of(self, rays: int, usual: int | None = None) -> Sizes:
        """Return the numbers of slots for a batch of rays.

        Args:
            rays: number of rays.
            usual: target number of samples per step. It bounds the kept samples, also when a resumed run has no counts
                yet. None for no bound but `MAX_SLOTS`.
        """
        needed = (SLOTS_MULTIPLE * math.ceil(each * rays / SLOTS_MULTIPLE) for each in self.per_ray)
        runs, candidates, kept = (min(number, MAX_SLOTS) for number in needed)
        return Sizes(runs, candidates, kept if usual is None else min(kept, MAX_KEPT * max(usual, SLOTS_MULTIPLE)))

    def note(self, rays: int, needed: tuple[Tensor, Tensor, Tensor], left_out: Tensor) -> None:
        """Record on the device the numbers that a step of `rays` `needed` (runs, candidates, samples) and `left_out`.

        All numbers are () tensors but `rays`; nothing waits for them.
        """
        per_ray = torch.stack(needed).float() / rays
        if self._needed is None or self._counted is None or self._needed.device != per_ray.device:
            self._needed, self._counted = torch.zeros_like(per_ray), left_out.new_zeros(2)
        self._needed.copy_(torch.maximum(self._needed, per_ray))
        self._counted[0].add_(rays)
        self._counted[1].add_(left_out)

    def read(self) -> None:
        """Read the needs of steps since the last reading, and set the capacity of the following steps."""
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
    """Return the capacity per ray for the largest need, `needed`; `given` if that still fits."""
    least = max(needed, 1.0)  # a step without samples may be followed by one with some
    return given if MIN_HEADROOM * least <= given <= MAX_HEADROOM * least else HEADROOM * least
