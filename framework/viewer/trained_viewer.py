"""A viewer of trained runs, or of runs training in another process: `ns-viewer`."""

from __future__ import annotations

import os
import time
from pathlib import Path

from nerfloom.base.console import say
from nerfloom.base.errors import NerfloomError
from nerfloom.training.checkpoint import FOLDER, list_checkpoints
from nerfloom.training.loaded import Loaded
from nerfloom.training.trained import load_parameters
from nerfloom.viewer.beside import check_beside
from nerfloom.viewer.commands import Commands
from nerfloom.viewer.page import Page
from nerfloom.viewer.photographs import Photographs
from nerfloom.viewer.render_queue import RenderQueue
from nerfloom.viewer.server import close_server, open_server

SECONDS_PER_LOOK = 2.0
"""Seconds between checks for a newer checkpoint."""


def view_loaded(
    loaded: Loaded,
    host: str,
    port: int,
    commands: Commands,
    follow: bool,
    second: Loaded | None = None,
    quick: Loaded | None = None,
) -> None:
    """Serve a run, a file of Gaussians or an octree to browsers until Ctrl-C.

    Args:
        loaded: the run or file.
        host: interface to listen on.
        port: port to listen on; the next free one if it is taken.
        commands: the commands that browsers start.
        follow: whether to show newer checkpoints of the run as they are written.
        second: a second run or file of the same data, which is shown beside the first; None for none.
        quick: a faster file of the same scene, which is drawn while the camera moves, not beside a second; None for
            none.

    Raises:
        ConfigError: if viser is missing, the address cannot be used, or the two cannot be shown side by side.
        KeyboardInterrupt: on Ctrl-C, after the server has stopped.
    """
    queue: RenderQueue
    photographs = Photographs(loaded.source, lambda: queue.loaded.model)
    for other in (second, quick):
        if other is not None:
            check_beside(loaded, other)
    ndc = photographs.ndc if loaded.model.scene.warped else None
    queue = RenderQueue(loaded, ndc=ndc, truth=photographs.truth, second=second, quick=quick)
    server = open_server(host, port)
    page = Page(server, queue, photographs, commands)
    say("Ctrl-C ends it")
    seen, looked = loaded.checkpoint, time.monotonic()
    try:
        while True:
            if queue.draw_next() is None:
                queue.wait(0.05 if not queue.is_empty else SECONDS_PER_LOOK)
            if time.monotonic() - looked >= SECONDS_PER_LOOK:
                looked = time.monotonic()
                seen = _follow(queue, page, seen) if follow else seen
    finally:
        page.close()
        close_server(server)


def _follow(queue: RenderQueue, page: Page, seen: Path) -> Path:
    """Show the newest checkpoint, if it is new, and return the newest one that was seen."""
    folder = queue.loaded.folder
    newer = newer_checkpoint(folder, seen)
    if newer is None:
        page.refresh()
        return seen
    found = reloaded(queue.loaded, newer)
    if isinstance(found, str):
        if os.path.exists(newer):  # it may have been replaced by a newer one meanwhile
            say(f"viewer: {found}")
    else:
        queue.loaded = found
        page.refresh()
    return newer


def newer_checkpoint(folder: Path, seen: Path | None) -> Path | None:
    """Return the newest checkpoint in a run's `folder`, unless it was `seen` before."""
    try:
        newest = list_checkpoints(folder / FOLDER)[-1:]
    except OSError:
        return None
    return newest[0] if newest and newest[0] != seen else None


def reloaded(loaded: Loaded, checkpoint: Path) -> Loaded | str:
    """Return the run `loaded` with parameters of a newer `checkpoint`, or the reason why it cannot be read."""
    try:
        return load_parameters(loaded.run, checkpoint)
    except (NerfloomError, OSError) as error:
        return f"{checkpoint.name} cannot be shown: {error}"
