"""The pace of a run with a time budget, and the durations of its steps."""

from __future__ import annotations

from dataclasses import dataclass

SHARE_OF_LAST = 0.1
"""Weight of the last measurement in the running mean."""


@dataclass(frozen=True)
class Pace:
    """Steps and seconds of a run so far, and its time budget."""

    step: int
    """Number of training steps done."""
    seconds: float
    """Seconds of training so far."""
    budget: float
    """Total seconds of training."""
    steps_per_read: int = 1
    """Steps between two waits for the device. Seconds are exact only over a multiple of this number."""

    @property
    def progress(self) -> float:
        """Spent fraction of the budget."""
        return min(self.seconds / self.budget, 1.0)


class StepTimes:
    """Measured durations of steps of different sizes.

    The first measurement of a run is dropped, since the first step allocates and compiles. When a size is measured
    again, the durations of all sizes are scaled by its ratio: more primitives and other programs slow down all sizes.
    """

    def __init__(self) -> None:
        self._seconds: dict[int, float] = {}
        self._size: int | None = None
        self._start: Pace | None = None
        self._last: Pace | None = None
        self._warm = False

    def of(self, size: int) -> float | None:
        """Return the seconds of a step of `size`; None if not measured."""
        return self._seconds.get(size)

    def learn(self, pace: Pace, size: int) -> None:
        """Measure the steps of a `size` since the last call; `pace` is the run's after them."""
        if size != self._size:
            self._size, self._start = size, self._last
        if self._start is not None and pace.step - self._start.step >= pace.steps_per_read:
            self._take(size, (pace.seconds - self._start.seconds) / (pace.step - self._start.step))
            self._start = pace
        self._last = pace
        self._start = self._start or pace

    def _take(self, size: int, found: float) -> None:
        if not self._warm:
            self._warm = True
        elif not (known := self._seconds.get(size, 0.0)) > 0:
            self._seconds[size] = found
        else:
            ratio = 1 + SHARE_OF_LAST * (found / known - 1)
            self._seconds = {other: seconds * ratio for other, seconds in self._seconds.items()}
