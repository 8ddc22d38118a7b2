"""A viewer of a run in training: `ns-train --vis viewer`.

Pictures are drawn between steps, in the training thread. So no lock is needed, and training cannot depend on them: each
step seeds its random numbers from (seed, step). Drawing takes a fixed share of the time.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from nerfloom.cameras.ndc import NdcCameras
from nerfloom.cameras.scale import read_scale
from nerfloom.training.checkpoint import FOLDER
from nerfloom.training.curve import in_order
from nerfloom.training.loaded import Loaded
from nerfloom.training.progress import StepReport
from nerfloom.training.run import Run
from nerfloom.training.trainer import BetweenSteps, Trainer
from nerfloom.viewer.pace import Share
from nerfloom.viewer.page import Page
from nerfloom.viewer.photographs import Photographs
from nerfloom.viewer.render_queue import RenderQueue
from nerfloom.viewer.server import close_server, open_server

if TYPE_CHECKING:
    import viser

PIECE_SECONDS = 0.04
"""Time limit for a picture, or a piece of it, between two steps, seconds."""
SECONDS_PER_REPORT = 0.5
"""Seconds between updates of the numbers in the panel."""
PAUSE = 0.05
"""Seconds between checks of the button while training is paused."""


class Turns:
    """The viewer's turns between steps of `trainer`: a `share` of the time for pictures that `queue` draws."""

    def __init__(self, trainer: Trainer, queue: RenderQueue, share: float) -> None:
        self._trainer, self._queue, self._share = trainer, queue, Share(share)
        self._ended = time.perf_counter()
        self.paused = False
        self.waited = 0.0

    def take(self, report: StepReport, stopped: Sequence[int]) -> None:
        """Draw within the share of time, after `report`; in a pause, until it ends or signals are in `stopped`."""
        start = time.perf_counter()
        if self._queue.is_empty and not self.paused:  # no browsers
            self._ended = start
            return
        self._share = self._share.earned(start - self._ended)
        self._queue.loaded = replace(self._queue.loaded, step=self._trainer.state.step)
        self._queue.hurried = True
        while self._share.credit > 0 and (seconds := self._queue.draw_next()) is not None:
            self._share = self._share.spent(seconds)
        while self.paused and not stopped:
            self._queue.hurried = False
            if self._queue.draw_next() is None:
                self._queue.wait(PAUSE)
        self._ended = time.perf_counter()
        self.waited += self._ended - start


class Status:
    """Numbers of `trainer`'s run, and its pause button for `turns`, in all browsers of `server`, with the `page`."""

    def __init__(self, server: viser.ViserServer, page: Page, trainer: Trainer, turns: Turns) -> None:
        self._page, self._trainer, self._turns = page, trainer, turns
        self._text = server.gui.add_markdown("")
        self._button = server.gui.add_button("Pause training")
        self._button.on_click(self._press)
        self._told = 0.0

    def _press(self, _: Any) -> None:
        self._turns.paused = not self._turns.paused
        self._button.label = "Continue training" if self._turns.paused else "Pause training"

    def show(self, report: StepReport) -> None:
        """Show the numbers of a step's `report`, unless others were shown a moment ago."""
        now = time.monotonic()
        if now - self._told < SECONDS_PER_REPORT:
            return
        self._told = now
        loss = sum(report.losses.values())
        self._text.content = (
            f"**{self._trainer.method.name}** · step {report.step:,} · {report.seconds:.0f} s  \n"
            f"loss {loss:.5f} · PSNR of batches {report.psnr:.2f} dB  \n{report.held_out_text}"
        )
        state = self._trainer.state
        points = in_order(state.curve, state.looks)
        self._page.show_curve([one.seconds for one in points], [one.psnr for one in points])


def in_training(run: Run, trainer: Trainer) -> Loaded:
    """Return the run of `trainer`, at its present step, for viewing."""
    placement, checkpoints = trainer.train_set.placement, run.folder / FOLDER
    loaded = Loaded(trainer.model, placement, run.method, run.folder, checkpoints, trainer.state.step, run)
    return loaded.scaled(read_scale(run.folder))


@contextmanager
def training_viewer(run: Run, trainer: Trainer) -> Iterator[BetweenSteps]:
    """Serve a run in training to browsers, within a `with` block.

    Yields:
        Function to be called between steps.

    Raises:
        ConfigError: if viser is missing, or the address cannot be used.
    """
    config, cameras = trainer.config, trainer.train_set.cameras
    photographs = Photographs(run, lambda: trainer.model)
    ndc = cameras.ndc if isinstance(cameras, NdcCameras) else None
    queue = RenderQueue(in_training(run, trainer), PIECE_SECONDS, PIECE_SECONDS, ndc, photographs.truth)
    turns = Turns(trainer, queue, config.viewer_share)
    server = open_server(config.viewer.websocket_host, config.viewer.websocket_port)
    page = Page(server, queue, photographs, commands=None)
    status = Status(server, page, trainer, turns)

    def between_steps(report: StepReport, stopped: Sequence[int]) -> None:
        if not queue.is_empty:
            status.show(report)
        turns.take(report, stopped)

    try:
        yield between_steps
    finally:
        page.close()
        close_server(server)
