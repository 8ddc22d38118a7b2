"""The measuring tool of one browser: two clicks on the picture, the length between them, and the scale."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from nerfloom.base.errors import NerfloomError
from nerfloom.cameras.view import View
from nerfloom.viewer.crop import views_within
from nerfloom.viewer.markdown import plain
from nerfloom.viewer.render_queue import RenderQueue
from nerfloom.viewer.request import Request, number_in

if TYPE_CHECKING:
    import viser

ROOM = "/measure"
"""Name of the points and the line in the scene."""
SIZE = 0.008
"""Radius of a point, as a fraction of its distance from the camera."""
COLOR = (255, 190, 0)
"""Colour of the points and the line."""
LONGEST = 1e9
"""Maximum true length."""


class MeasurePanel:
    """Controls of one browser `client` for measuring, in the model of a `queue`, in views of the browser's `request`.

    Points are found in the thread that draws, because a model in training changes between its steps.
    """

    def __init__(self, client: viser.ClientHandle, queue: RenderQueue, request: Callable[[], Request | None]) -> None:
        self._client, self._queue, self._request = client, queue, request
        self._points: list[tuple[Tensor, float]] = []
        self._time: float | None = None
        gui = client.gui
        self._picking = gui.add_checkbox(
            "Pick points", False, hint="Click two points of the picture; a third begins a new length."
        )
        self._picking.on_update(lambda _: self._listen())
        self._note = gui.add_markdown("")
        if queue.loaded.is_run:
            with gui.add_folder("Set the scale", expand_by_default=False):
                self._distance = gui.add_number("True length", 1.0, min=0.0, hint="Length between the two points.")
                self._unit = gui.add_text("Unit", "m", hint="m, cm, inch, ...")
                gui.add_button("Set scale").on_click(lambda _: queue.do(self._set_scale))
        self._tell("")

    def _tell(self, text: str) -> None:
        """Show a text, and the unit of lengths."""
        scale = self._queue.loaded.scale
        unit = plain(scale.unit) if scale.is_known else "the unit of the input"
        self._note.content = f"{text}  \nLengths are in {unit}."

    def _listen(self) -> None:
        """Begin or end to take clicks on the picture as points."""
        self._client.scene.remove_click_callback(self._clicked)
        if self._picking.value is True:
            self._client.scene.on_click()(self._clicked)
            self._tell("Click the first point.")
        else:
            self._points = []
            self._client.scene.remove_by_name(ROOM)
            self._tell("")

    def _clicked(self, event: Any) -> None:
        request = self._request()
        if request is not None:
            x, y = (number_in(value, 0, 1, 0.5) for value in event.screen_pos)
            column, row = x * request.width - 0.5, y * request.height - 0.5
            self._queue.do(lambda: self._pick(request, column, row))

    # -- in the drawing thread --------------------------------------------------------------------------------

    def _pick(self, request: Request, column: float, row: float) -> None:
        """Add the point at a pixel of a view, and show the length if there are two."""
        loaded = self._queue.loaded
        scene, whole = loaded.model.scene, View(request.camera().to(loaded.model.device), request.time)
        problem = ""
        for view in views_within(whole, request.crop, column, row, scene.near, scene.far):
            try:
                point = loaded.placement.points(loaded.pick(view, column, row)[None])[0]
                break
            except NerfloomError as error:
                problem = str(error)
        else:
            self._tell(f"{plain(problem)}.")
            return
        size = SIZE * float((point - request.pose.tensor()[:, 3]).norm())
        self._points = [*(self._points if len(self._points) == 1 else []), (point, size)]
        self._time = request.time
        self._show()

    def _show(self) -> None:
        """Draw the points and the line, and tell the length."""
        scene = self._client.scene
        scene.remove_by_name(ROOM)
        scene.add_frame(ROOM, show_axes=False)
        for number, (point, size) in enumerate(self._points):
            scene.add_icosphere(f"{ROOM}/{number}", radius=size, color=COLOR, position=tuple(point.tolist()))
        if len(self._points) < 2:
            place = self._queue.loaded.placement.original_points(self._points[0][0][None])[0]
            self._tell(f"{','.join(f'{value:.6g}' for value in place.tolist())}  \nClick the second point.")
            return
        ends = torch.stack([point for point, _ in self._points])
        loaded = self._queue.loaded
        try:
            start, end = loaded.placement.original_points(ends)
            length = str(loaded.measure(start, end, self._time))
        except NerfloomError as error:
            self._tell(f"{plain(str(error))}.")
            return
        line = ends.numpy().astype(np.float32)[None]
        scene.add_line_segments(
            f"{ROOM}/line", line, np.array(COLOR, np.uint8), thickness=3.0, thickness_units="screen"
        )
        scene.add_label(f"{ROOM}/length", length.partition(" (")[0], position=tuple(ends.mean(0).tolist()))
        self._tell(f"**{length}**")

    def _set_scale(self) -> None:
        """Give the two points their true distance, and keep the scale with the run."""
        if len(self._points) < 2:
            self._tell("Pick two points first.")
            return
        loaded = self._queue.loaded
        start, end = loaded.placement.original_points(torch.stack([point for point, _ in self._points]))
        try:
            found = loaded.with_scale(
                start, end, number_in(self._distance.value, 0, LONGEST, 0), str(self._unit.value), self._time
            )
            found.keep_scale()
        except (NerfloomError, OSError) as error:
            self._tell(f"{plain(str(error))}.")
            return
        self._queue.loaded = found
        self._show()
