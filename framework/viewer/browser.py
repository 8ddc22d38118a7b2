"""One browser's picture: what it asks for, and how much of that is drawn."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from nerfloom.evaluation.outputs import Arrays, distance_range
from nerfloom.viewer.canvas import enlarged, paste
from nerfloom.viewer.drawing import colored, number_kept
from nerfloom.viewer.pace import Piece, Rays, Speed, Waiting, refinement
from nerfloom.viewer.request import Request

ROUGH_QUALITY, FINE_QUALITY = 70, 95
"""Quality of JPEG files while a picture is coarse, and when it is finished."""
RENEWAL = 1.0
"""Seconds after which a finished picture of a model that has changed is drawn again."""
Show = Callable[[np.ndarray, int], None]
"""Function that sends a picture (H, W, 3) uint8 to the browser, as a JPEG of a quality."""


@dataclass
class Browser:
    """A connected browser: its request, which any thread may replace, and its picture, which one thread draws."""

    show: Show
    """Sends a picture to the browser."""
    wanted: Request | None = None
    """What it asks for; None before its first camera is known."""
    asked_at: float = 0.0
    """Time of the last request, `time.monotonic`."""
    drawn: Request | None = None
    """What is shown, at least coarsely."""
    stride: int | None = None
    """Stride of the last coarse picture, pixels."""
    step: int = -1
    """Training step of the picture, when its last pass began."""
    served_at: float = 0.0
    """Time at which something was last drawn."""
    pieces: list[Piece] = field(default_factory=list)
    """What is left to be drawn."""
    _canvas: dict[str, np.ndarray] = field(default_factory=dict)
    _range: tuple[float, float] | None = None

    def ask(self, request: Request) -> bool:
        """Take a new `request` in place of the last, and return whether it differs."""
        if request == self.wanted:
            return False
        self.asked_at, self.wanted = time.monotonic(), request
        return True

    def waiting(self, step: int, now: float) -> Waiting:
        """Return what the browser waits for.

        Args:
            step: training step of the model.
            now: time, `time.monotonic`.
        """
        old = step != self.step and now - self.served_at >= RENEWAL
        new = self.wanted is not None and self.wanted != self.drawn
        return Waiting(new, self.drawn is not None and (bool(self.pieces) or old), self.asked_at, self.served_at)

    def begin(self, request: Request, stride: int, step: int, kept: Arrays, left: list[Piece]) -> None:
        """Show a coarse picture of a new request.

        Args:
            request: what was asked for.
            stride: stride of the picture.
            step: training step of the model.
            kept: what was kept of the picture.
            left: pieces that finish it.
        """
        self.drawn, self.stride, self.step, self.pieces = request, stride, step, left
        self._canvas = dict(kept)
        self._range = None if (name := number_kept(kept)) is None else distance_range([kept], name)
        self.show(colored(kept, self._range), ROUGH_QUALITY if left else FINE_QUALITY)

    def renew(self, speed: Speed, rays: Rays, step: int, seconds: float) -> None:
        """Begin to draw the finished picture again, for a model that has changed.

        Args:
            speed: what was measured.
            rays: rays per pixel.
            step: training step of the model.
            seconds: time that a piece may take.
        """
        assert self.drawn is not None
        self.step = step
        self.pieces = refinement(speed, self.drawn.width, self.drawn.height, 1, rays, seconds)

    def refine(self, kept: Arrays) -> None:
        """Show the next piece of `pieces`.

        Args:
            kept: what was kept of the piece.
        """
        assert self.drawn is not None
        piece = self.pieces.pop(0)
        width, height = self.drawn.width, self.drawn.height
        same = self._canvas.keys() == kept.keys()
        if not same:  # a photograph was found, or lost, on the way
            self._canvas, self.drawn = {}, None
            return
        if next(iter(self._canvas.values())).shape[:2] != (height, width):
            self._canvas = enlarged(self._canvas, width, height)
        paste(self._canvas, kept, piece)
        if not self.pieces and (name := number_kept(self._canvas)) is not None:
            self._range = distance_range([self._canvas], name)
        self.show(colored(self._canvas, self._range), ROUGH_QUALITY if self.pieces else FINE_QUALITY)
