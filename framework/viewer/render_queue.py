"""Drawing for all browsers, one piece at a time, in the thread that calls `RenderQueue.draw_next`."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import cast

from nerfloom.base.console import say
from nerfloom.base.errors import NerfloomError, one_line
from nerfloom.cameras.ndc import Ndc
from nerfloom.evaluation.outputs import Arrays
from nerfloom.renderable import RendersRays
from nerfloom.training.loaded import Loaded
from nerfloom.viewer.beside import draw_beside, draw_other
from nerfloom.viewer.browser import Browser
from nerfloom.viewer.drawing import Truth
from nerfloom.viewer.pace import Piece, Rays, Speed, coarse_stride, next_browser, refinement
from nerfloom.viewer.request import Request, smaller

REFINE_AFTER = 0.15
"""Seconds without a new request before a picture is refined."""
NO_LIMIT = 1e6
"""Time limit for a piece of a method that casts no rays, seconds, so large that a piece is the whole picture. Gaussians
near an image's border depend on the image's size, so strips of it would differ from the whole: on fox they had 28
dB."""
SHARED = ("rgb", "depth", "accumulation")
"""Outputs that look alike in a run and in a faster file of its scene."""
PROBLEMS = NerfloomError, MemoryError, RuntimeError, ValueError
"""Errors of a picture or a task that the viewer reports without stopping."""


class RenderQueue:
    """Pictures of one model for several browsers.

    Browsers come, go and send requests in any thread. `draw_next` draws everything in the calling thread, so that a
    model in training is never read while it changes.

    Args:
        loaded: the model and its run.
        coarse_seconds: time limit for a picture while the camera moves.
        piece_seconds: time limit for a piece of a refinement.
        ndc: function that returns the normalised device coordinates of the scene; None if it has none.
        truth: true images for the output `error` and the overlay.
        second: a second run or file, drawn beside the first; None for none.
        quick: a faster file of the same scene, drawn while the camera moves, not beside a second; None for the run
            itself.
    """

    def __init__(
        self,
        loaded: Loaded,
        coarse_seconds: float = 0.1,
        piece_seconds: float = 0.1,
        ndc: Ndc | None = None,
        truth: Truth | None = None,
        second: Loaded | None = None,
        quick: Loaded | None = None,
    ) -> None:
        self.loaded, self.second, self._quick = loaded, second, quick
        self.coarse_seconds, self.piece_seconds = coarse_seconds, piece_seconds
        self.hurried = False
        self._ndc, self._truth = ndc, truth
        self._speed, self._quick_speed = Speed(), Speed()
        self._browsers: dict[int, Browser] = {}
        self._tasks: deque[Callable[[], None]] = deque()
        self._lock = threading.Lock()
        self._asked = threading.Event()

    # -- any thread -------------------------------------------------------------------------------------------

    def add(self, number: int, browser: Browser) -> None:
        """Add a `browser` with its `number`."""
        with self._lock:
            self._browsers[number] = browser

    def remove(self, number: int) -> None:
        """Remove the browser with a `number`, if it exists."""
        with self._lock:
            self._browsers.pop(number, None)

    def ask(self, number: int, change: Callable[[Request | None], Request | None]) -> None:
        """Replace a browser's request.

        Args:
            number: number of the browser.
            change: function from its last request, None if there is none, to the new one.
        """
        with self._lock:
            browser = self._browsers.get(number)
            request = None if browser is None else change(browser.wanted)
            if browser is None or request is None or not browser.ask(request):
                return
        self._asked.set()

    def do(self, task: Callable[[], None]) -> None:
        """Have a `task` done between two pictures, by the thread that draws."""
        self._tasks.append(task)
        self._asked.set()

    @property
    def is_empty(self) -> bool:
        """True if there are no browsers."""
        return not self._browsers

    # -- the drawing thread -----------------------------------------------------------------------------------

    def wait(self, seconds: float) -> None:
        """Wait for a request, at most `seconds` seconds."""
        self._asked.wait(seconds)
        self._asked.clear()

    def draw_next(self) -> float | None:
        """Do a task or draw the next piece for a browser, and return the seconds it took; None if there is none."""
        with self._lock:
            browsers = list(self._browsers.values())
        now, start = time.monotonic(), time.perf_counter()
        if self._tasks:
            try:
                self._tasks.popleft()()
            except PROBLEMS as error:
                say(f"viewer: {one_line(error)}")
            return time.perf_counter() - start
        index = next_browser([one.waiting(self.loaded.step, now) for one in browsers], now, REFINE_AFTER)
        if index is None:
            return None
        browser = browsers[index]
        try:
            self._serve(browser)
        except PROBLEMS as error:
            say(f"viewer: a picture could not be drawn: {one_line(error)}")
            browser.drawn, browser.pieces, browser.step = browser.wanted, [], self.loaded.step
        browser.served_at = time.monotonic()
        return time.perf_counter() - start

    def _serve(self, browser: Browser) -> None:
        """Draw the next piece for a browser."""
        request, step, budget = browser.wanted, self.loaded.step, self._piece_seconds
        assert request is not None
        if request != browser.drawn:
            # The run draws its first picture itself: its speed determines the size of its pieces.
            quick = self._quick if self._speed.measured and _is_shared(request) else None
            speed = self._speed if quick is None else self._quick_speed
            stride = coarse_stride(speed, request.width, request.height, self.coarse_seconds, browser.stride)
            whole = Piece(stride, 1, 0, smaller(request.width, request.height, stride)[1])
            kept = self._timed(request, whole) if quick is None else self._quickly(quick, request, whole)
            left: list[Piece] = []
            if quick is not None or stride > 1 or self._rays > 1:
                left = refinement(self._speed, request.width, request.height, stride, self._rays, budget)
            browser.begin(request, stride, step, kept, left)
            return
        if not browser.pieces:
            browser.renew(self._speed, self._rays, step, budget)
        browser.refine(self._timed(request, browser.pieces[0]))

    @property
    def _piece_seconds(self) -> float:
        shown = (self.loaded,) if self.second is None else (self.loaded, self.second)
        return self.piece_seconds if all(isinstance(one.model, RendersRays) for one in shown) else NO_LIMIT

    @property
    def _rays(self) -> Rays:
        """Rays per pixel of a finished picture; one while there is other work."""
        return 1 if self.hurried else cast("Rays", self.loaded.model.rays_per_pixel)

    def _timed(self, request: Request, piece: Piece) -> Arrays:
        """Draw a piece and measure its time."""
        start = time.perf_counter()
        kept = draw_beside(self.loaded, self.second, request, piece, self._ndc, self._truth)
        self._speed = self._speed.with_one(_rays_of(request, piece), time.perf_counter() - start)
        return kept

    def _quickly(self, quick: Loaded, request: Request, piece: Piece) -> Arrays:
        """Draw a piece of the faster file and measure its time."""
        start = time.perf_counter()
        kept = draw_other(self.loaded, quick, request, piece)
        self._quick_speed = self._quick_speed.with_one(_rays_of(request, piece), time.perf_counter() - start)
        return kept


def _is_shared(request: Request) -> bool:
    """Return whether a faster file can show the picture of a request, with arrays of the same names as the run's."""
    return request.output in SHARED and not request.overlay


def _rays_of(request: Request, piece: Piece) -> int:
    columns, _ = smaller(request.width, request.height, piece.stride)
    return columns * (piece.bottom - piece.top) * piece.rays
