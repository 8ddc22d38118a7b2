"""The size of the next piece of a picture, from measured times: pure functions that read no clock.

The stride of the coarse picture comes from a model of drawing time, a line fitted to the last measurements, with
hysteresis. This avoids a loop from a slow picture to a coarse, fast one, to a fine one and back.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

from nerfloom.viewer.request import smaller

STRIDES = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64)
"""Strides of coarse pictures, pixels."""
FIRST_PIXELS = 6_000
"""Number of pixels of the first picture, before any measurement."""
KEPT_MEASUREMENTS = 16
"""Number of pictures used to estimate the speed."""
KEPT_STRIDE_COSTS = (0.5, 1.4)
"""A stride is kept while its picture takes at most the second value times the budget, and the next finer stride's
picture at least the first value times the budget."""
MAX_RATIO = 4
"""Maximum ratio of the strides of consecutive passes."""
MIN_ROWS = 4
"""Minimum number of rows of a piece."""
Rays = Literal[1, 4, 9, 16]
"""Number of rays averaged per pixel."""


@dataclass(frozen=True)
class Speed:
    """Drawing time as a function of the number of rays, fitted to the last measurements."""

    measured: tuple[tuple[int, float], ...] = ()
    """Number of rays, and seconds."""

    def with_one(self, rays: int, seconds: float) -> Speed:
        """Return the speed with one more picture of `rays`, or of pixels without rays, drawn in `seconds`."""
        return Speed((*self.measured, (max(rays, 1), max(seconds, 1e-6)))[-KEPT_MEASUREMENTS:])

    def line(self) -> tuple[float, float]:
        """Return the seconds per picture and per ray, a line with least squared relative errors."""
        weights = [seconds**-2 for _, seconds in self.measured]
        total = sum(weights)
        x = sum(w * rays for w, (rays, _) in zip(weights, self.measured, strict=True)) / total
        y = sum(w * seconds for w, (_, seconds) in zip(weights, self.measured, strict=True)) / total
        spread = sum(w * (rays - x) ** 2 for w, (rays, _) in zip(weights, self.measured, strict=True)) / total
        if spread < (0.05 * x) ** 2:  # with pictures of one size only, time is taken as proportional
            return 0.0, y / x
        both = [w * (rays - x) * (seconds - y) for w, (rays, seconds) in zip(weights, self.measured, strict=True)]
        slope = sum(both) / total / spread
        if slope <= 0:
            return y, 0.0
        return (y - slope * x, slope) if slope * x < y else (0.0, y / x)

    def seconds(self, rays: int) -> float:
        """Return the estimated time of a picture with `rays` rays."""
        fixed, each = self.line()
        return fixed + each * rays

    def rays(self, seconds: float) -> float:
        """Return the number of rays of a picture that takes `seconds`, but not less than the fixed part."""
        fixed, each = self.line()
        return max(seconds - fixed, fixed, 0.2 * seconds) / max(each, 1e-12)


def coarse_stride(speed: Speed, width: int, height: int, budget: float, before: int | None) -> int:
    """Return the stride of pictures shown while the camera moves.

    Args:
        speed: measured speed.
        width, height: size of the whole picture, pixels.
        budget: time limit for the picture, seconds.
        before: stride of the previous picture; None for the first.
    """

    def rays(stride: int) -> int:
        w, h = smaller(width, height, stride)
        return w * h

    if not speed.measured:
        return next((stride for stride in STRIDES if rays(stride) <= FIRST_PIXELS), STRIDES[-1])
    if before is not None:
        finer = [stride for stride in STRIDES if stride < before]
        slow = speed.seconds(rays(before)) > KEPT_STRIDE_COSTS[1] * budget
        could_be_finer = bool(finer) and speed.seconds(rays(finer[-1])) < KEPT_STRIDE_COSTS[0] * budget
        if not slow and not could_be_finer:
            return before
    return next((stride for stride in STRIDES if speed.seconds(rays(stride)) <= budget), STRIDES[-1])


@dataclass(frozen=True)
class Piece:
    """Rows of a picture at a stride, drawn together."""

    stride: int
    """Stride of the picture, pixels."""
    rays: Rays
    """Number of rays averaged per pixel."""
    top: int
    """First row, at this stride."""
    bottom: int
    """The row after the last."""


def refinement(speed: Speed, width: int, height: int, shown: int, rays: Rays, seconds: float) -> list[Piece]:
    """Return the pieces that turn a coarse picture into the finished one, in drawing order.

    Each pass is finer than the one before, and starts in the middle of the picture.

    Args:
        speed: measured speed.
        width, height: size of the whole picture, pixels.
        shown: stride of the current picture; 1 to replace only its pixels' colours.
        rays: rays per pixel of the finished picture.
        seconds: time limit for a piece.
    """
    pieces: list[Piece] = []
    stride = shown
    while stride > 1:
        last = stride <= MAX_RATIO or speed.seconds(width * height) <= 2 * seconds
        stride = 1 if last else max(stride // MAX_RATIO, 2)
        pieces += _bands(speed, width, height, stride, 1, seconds)
    if shown == 1 or rays > 1:
        pieces += _bands(speed, width, height, 1, rays, seconds)
    return pieces


def _bands(speed: Speed, width: int, height: int, stride: int, rays: Rays, seconds: float) -> list[Piece]:
    """Return the pieces of one pass, from the middle outwards."""
    columns, rows = smaller(width, height, stride)
    each = rows
    if speed.measured:
        each = min(max(int(speed.rays(seconds) / (columns * rays)), MIN_ROWS), rows)
    count = -(-rows // each)
    edges = [round(index * rows / count) for index in range(count + 1)]
    bands = [Piece(stride, rays, top, bottom) for top, bottom in pairwise(edges)]
    return sorted(bands, key=lambda piece: abs(piece.top + piece.bottom - rows))


@dataclass(frozen=True)
class Share:
    """Share of time for pictures while other work runs."""

    share: float
    """Fraction of the total time for pictures, 0 to 1."""
    most: float = 0.2
    """Maximum credit, seconds; unused time beyond it is lost."""
    credit: float = 0.0
    """Seconds available for pictures now; negative after a picture that took too long."""

    def earned(self, seconds: float) -> Share:
        """Return the share after `seconds` of other work."""
        if self.share >= 1:
            return replace(self, credit=self.most)
        return replace(self, credit=min(self.credit + seconds * self.share / (1 - self.share), self.most))

    def spent(self, seconds: float) -> Share:
        """Return the share after a picture that took `seconds`."""
        return replace(self, credit=self.credit - seconds)


@dataclass(frozen=True)
class Waiting:
    """A browser's claim to be served, as used for the drawing order."""

    new: bool
    """Whether its current request has no picture yet."""
    rough: bool
    """Whether its picture is unfinished, or older than the model."""
    asked_at: float
    """Time of its last request, seconds."""
    served_at: float
    """Time of the last drawing for it, seconds."""


def next_browser(waiting: Sequence[Waiting], now: float, rest: float) -> int | None:
    """Return the browser to draw for next; None if all are served.

    New requests come first; among these, the browser served least recently. A picture is refined when its camera has
    rested for a while.

    Args:
        waiting: claims of the browsers.
        now: time, seconds.
        rest: seconds without a new request before a picture is refined.
    """
    new = [index for index, one in enumerate(waiting) if one.new]
    rough = [index for index, one in enumerate(waiting) if one.rough and now - one.asked_at >= rest]
    return min(new or rough, key=lambda index: waiting[index].served_at, default=None)
