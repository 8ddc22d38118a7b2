"""State of one browser: its request, and the progress of its picture."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from nerfloom.evaluation.outputs import Arrays, distance_range
from nerfloom.viewer.beside import with_divider
from nerfloom.viewer.canvas import enlarged, paste
from nerfloom.viewer.drawing import colored, number_kept
from nerfloom.viewer.pace import Piece, Rays, Speed, Waiting, refinement
from nerfloom.viewer.request import Request

ROUGH_QUALITY, FINE_QUALITY = 70, 95
"""JPEG quality of coarse and of finished pictures."""
RENEWAL = 1.0
"""Seconds until a finished picture is redrawn if the model has changed."""
Show = Callable[[np.ndarray, int], None]
"""Function that sends a picture (H, W, 3) uint8 to the browser, as a JPEG of a given quality. It does not
keep the array, which changes with the next piece."""


@dataclass
class Browser:
    """A connected browser. Any thread may replace its request; one thread draws its picture."""

    show: Show
    """Sends a picture to the browser."""
    wanted: Request | None = None
    """Current request; None before the first camera is known."""
    asked_at: float = 0.0
    """Time of the last request, `time.monotonic`."""
    drawn: Request | None = None
    """Request of the picture shown, at least coarsely."""
    stride: int | None = None
    """Stride of the last coarse picture, pixels."""
    step: int = -1
    """Training step at the beginning of the picture's last pass."""
    served_at: float = 0.0
    """Time of the last drawing."""
    pieces: list[Piece] = field(default_factory=list)
    """Pieces still to be drawn."""
    _canvas: dict[str, np.ndarray] = field(default_factory=dict)
    _range: tuple[float, float] | None = None

    def ask(self, request: Request) -> bool:
        """Replace the request by a new `request`, and return whether it differs."""
        if request == self.wanted:
            return False
        self.asked_at, self.wanted = time.monotonic(), request
        return True

    def waiting(self, step: int, now: float) -> Waiting:
        """Return the browser's claim to be served at time `now`, by `time.monotonic`, and training step `step`."""
        old = step != self.step and now - self.served_at >= RENEWAL
        new = self.wanted is not None and self.wanted != self.drawn
        return Waiting(new, self.drawn is not None and (bool(self.pieces) or old), self.asked_at, self.served_at)

    def begin(self, request: Request, stride: int, step: int, kept: Arrays, left: list[Piece]) -> None:
        """Show the coarse arrays `kept`, at a `stride`, of training step `step`; the pieces `left` complete them."""
        self.drawn, self.stride, self.step, self.pieces = request, stride, step, left
        self._canvas = dict(kept)
        self._range = None if (name := number_kept(kept)) is None else distance_range([kept], name)
        self._show(ROUGH_QUALITY if left else FINE_QUALITY)

    def renew(self, speed: Speed, rays: Rays, step: int, seconds: float) -> None:
        """Start to redraw the picture, of `rays` per pixel, for a model of `step`, `seconds` a piece at `speed`."""
        assert self.drawn is not None
        self.step = step
        self.pieces = refinement(speed, self.drawn.width, self.drawn.height, 1, rays, seconds)

    def refine(self, kept: Arrays) -> None:
        """Show the next piece of `pieces`, with the arrays `kept`."""
        assert self.drawn is not None
        piece = self.pieces.pop(0)
        width, height = self.drawn.width, self.drawn.height
        same = self._canvas.keys() == kept.keys()
        if not same:  # a photograph appeared or disappeared meanwhile
            self._canvas, self.drawn = {}, None
            return
        if next(iter(self._canvas.values())).shape[:2] != (height, width):
            self._canvas = enlarged(self._canvas, width, height)
        paste(self._canvas, kept, piece)
        if not self.pieces and (name := number_kept(self._canvas)) is not None:
            self._range = distance_range([self._canvas], name)
        self._show(ROUGH_QUALITY if self.pieces else FINE_QUALITY)

    def _show(self, quality: int) -> None:
        """Send the picture as it is now. While the camera moves its pixels are coarse, and it has no divider."""
        assert self.drawn is not None
        picture = colored(self._canvas, self._range)
        is_whole = picture.shape[1] == self.drawn.width
        self.show(with_divider(picture, self.drawn.divider if is_whole else None), quality)
