"""The floaters of a scene in one browser: red points over the picture, which are looked for when asked for."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from nerfloom.base.errors import NerfloomError
from nerfloom.viewer.floaters import find_floaters
from nerfloom.viewer.markdown import plain
from nerfloom.viewer.render_queue import RenderQueue
from nerfloom.viewer.request import Request

if TYPE_CHECKING:
    import viser

ROOM = "/floaters"
"""Name of the points in the scene."""
COLOR = (255, 40, 40)
"""Colour of the points."""
SIZE = 1 / 300
"""Size of a point, as a fraction of the longest edge of the scene's box."""


class FloaterPanel:
    """Controls of one browser `client` for floaters, in the model of a `queue`, at the time of the browser's `request`.

    They are looked for in the thread that draws, because a model in training changes between its steps.
    """

    def __init__(self, client: viser.ClientHandle, queue: RenderQueue, request: Callable[[], Request | None]) -> None:
        self._client, self._queue, self._request = client, queue, request
        self._shown = client.gui.add_checkbox(
            "Show floaters", False, hint="Red points where something is in front of surfaces that photographs see."
        )
        self._shown.on_update(lambda _: self._switched())
        self._note = client.gui.add_markdown("")

    def _switched(self) -> None:
        self._client.scene.remove_by_name(ROOM)
        if self._shown.value is True:
            self._note.content = "Looking from the photographs ..."
            self._queue.do(self._show)
        else:
            self._note.content = ""

    def _show(self) -> None:
        """Find the floaters and show them, in the drawing thread."""
        if self._shown.value is not True:  # switched off meanwhile
            return
        loaded, request = self._queue.loaded, self._request()
        try:
            found = find_floaters(loaded, None if request is None else request.time)
        except NerfloomError as error:
            self._note.content = f"{plain(str(error))}."
            return
        self._note.content = f"{plain(found.words)}."
        if len(found.positions):
            box = loaded.model.scene.box
            self._client.scene.add_point_cloud(
                ROOM,
                found.positions.numpy().astype(np.float32),
                np.tile(np.array(COLOR, np.uint8), (len(found.positions), 1)),
                point_size=SIZE * float((box[1] - box[0]).max()),
                precision="float32",
            )
