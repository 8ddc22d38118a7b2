"""Progress of an operation: finished units and the time left."""

from __future__ import annotations

import time
from collections.abc import Callable

UNKNOWN = "–"
"""Text for an unknown value."""


def time_text(seconds: float) -> str:
    """Return a duration of `seconds` for people, such as ``45 s``, ``3 min`` or ``2 h 05 min``."""
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60:02d} min"


def left_text(seconds: float | None) -> str:
    """Return the time left in `seconds` as text, such as ``3 min left``, or with a dash if it is None."""
    return f"{UNKNOWN if seconds is None else time_text(seconds)} left"


class Meter:
    """Progress of an operation: finished units and the time left.

    The time left assumes that each remaining unit takes the mean time of the finished ones. Speed over the last seconds
    would be unknown for units that take minutes.

    Args:
        title: text that names the operation.
        total: number of units; None if unknown.
        done: number of units that are already finished.
        spent: seconds that these units took; None to leave them out of the estimate.
        clock: function that returns seconds.
        number: function that formats a number of units.
    """

    def __init__(
        self,
        title: str,
        total: int | None,
        done: int = 0,
        spent: float | None = None,
        clock: Callable[[], float] = time.monotonic,
        number: Callable[[int], str] = "{:,}".format,
    ) -> None:
        self._title, self._total, self._clock, self._number = title, total, clock, number
        self._done, self._first = done, done if spent is None else 0
        self._last = clock()
        self._start = self._last - (spent or 0.0)

    def advance(self, count: int = 1) -> None:
        """Count `count` more units as finished."""
        self._done += count
        self._last = self._clock()

    @property
    def seconds_left(self) -> float | None:
        """Estimated seconds for the remaining units; None if their number is unknown or none has finished yet."""
        counted = self._done - self._first
        if not counted or self._total is None:
            return None
        others = (self._last - self._start) / counted * max(self._total - self._done, 0)
        return max(others - (self._clock() - self._last), 0.0)

    @property
    def left(self) -> str:
        """The time left, as text."""
        return left_text(self.seconds_left)

    @property
    def state(self) -> str:
        """The finished units, their percentage and the time left, as text."""
        if self._total is None:
            return self._number(self._done)
        share = 100 * self._done / max(self._total, 1)
        return f"{share:.0f} %, {self._number(self._done)} of {self._number(self._total)}, {self.left}"

    @property
    def line(self) -> str:
        """The operation and its state, as text."""
        return f"{self._title}: {self.state}"
