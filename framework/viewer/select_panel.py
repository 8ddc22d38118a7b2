"""The selections of one browser: outlines drawn over the picture, with their inside kept or removed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from nerfloom.cameras.outline import outlined
from nerfloom.geometry.regions import Place, Polygon
from nerfloom.viewer.request import Request, number_in

if TYPE_CHECKING:
    import viser

ROOM = "/selection"
"""Name of the outline in the scene."""
COLOR = (255, 60, 120)
"""Colour of the outline."""
STILL = 1e-5
"""Maximum change of the numbers of a camera's pose that does not count as a movement."""
MOST = 200
"""Maximum number of corners of all selections together: each takes time in each picture."""


class SelectPanel:
    """Controls of one browser for its selections.

    All callbacks run in the server's own thread, so that they stay in order.

    Args:
        client: the browser.
        request: function that returns the browser's request; None if its camera is invalid.
        changed: function that is called when the selections have changed.
        distance: distance of a drawn outline from the camera, scene units.
    """

    polygons: tuple[Polygon, ...] = ()
    """The selections, in the frame of the scene; what is in all of them is shown."""

    def __init__(
        self,
        client: viser.ClientHandle,
        request: Callable[[], Request | None],
        changed: Callable[[], None],
        distance: float,
    ) -> None:
        self._client, self._request, self._changed, self._distance = client, request, changed, distance
        self._is_drawing = False
        self._view: Request | None = None
        self._corners: tuple[Place, ...] = ()
        buttons = {
            "Draw a rectangle": (self._draw_rectangle, "Then keep or remove what the picture shows in it."),
            "Draw an outline": (self._draw_outline, "Then keep or remove what the picture shows in it."),
            "Keep inside": (self._keep, "At any distance from this camera."),
            "Remove inside": (self._remove, "At any distance from this camera."),
            "Undo": (self._undo, "Take back what is drawn, or the last selection."),
        }
        for label, (action, hint) in buttons.items():
            client.gui.add_button(label, hint=hint).on_click(action)
        self._note = client.gui.add_markdown("")

    # -- drawing ----------------------------------------------------------------------------------------------

    async def _draw_rectangle(self, _: Any) -> None:
        self._begin()
        self._client.scene.on_rect_select()(self._dragged)
        self._note.content = "Drag a rectangle over the picture."

    async def _draw_outline(self, _: Any) -> None:
        self._begin()
        self._client.scene.on_click()(self._clicked)
        self._note.content = "Click the corners of an outline, and do not move the camera."

    async def _dragged(self, event: Any) -> None:
        (left, top), (right, bottom) = place_of(event.screen_min), place_of(event.screen_max)
        if left < right and top < bottom:
            self._client.scene.remove_rect_select_callback(self._dragged)  # the mouse moves the camera again
            self._add([(left, top), (right, top), (right, bottom), (left, bottom)])

    async def _clicked(self, event: Any) -> None:
        self._add([place_of(event.screen_pos)])

    def _add(self, places: Sequence[Place]) -> None:
        """Add corners, as fractions of the picture's width and height; from another camera, a new outline begins."""
        view = self._request()
        if view is None:
            return
        if self._view is None or not is_same(self._view, view):
            self._view, self._corners = view, ()
        if sum(len(polygon.corners) for polygon in self.polygons) + len(self._corners) + len(places) > MOST:
            self._note.content = f"There are {MOST} corners, which is the maximum."
            return
        pixels = ((x * self._view.width - 0.5, y * self._view.height - 0.5) for x, y in places)
        self._corners = (*self._corners, *pixels)
        lines = segments(self._view, self._corners, self._distance)
        self._client.scene.add_line_segments(
            ROOM, lines, np.array(COLOR, np.uint8), thickness=2.0, thickness_units="screen"
        )
        count = len(self._corners)
        self._note.content = f"{count} corner{'s' if count > 1 else ''}. Keep or remove the inside."

    def _begin(self) -> None:
        """Begin a new outline."""
        self._end()
        self._is_drawing = True

    def _end(self) -> None:
        """End to draw, and forget the outline."""
        self._client.scene.remove_rect_select_callback(self._dragged)
        self._client.scene.remove_click_callback(self._clicked)
        self._client.scene.remove_by_name(ROOM)
        self._is_drawing, self._view, self._corners = False, None, ()

    # -- selecting --------------------------------------------------------------------------------------------

    async def _keep(self, _: Any) -> None:
        self._select(keep=True)

    async def _remove(self, _: Any) -> None:
        self._select(keep=False)

    def _select(self, keep: bool) -> None:
        if self._view is None or len(self._corners) < 3:
            self._note.content = "Draw a rectangle first, or an outline with three corners."
            return
        self.polygons = (*self.polygons, outlined(self._view.camera(), self._corners, keep))
        self._end()
        self._show()

    async def _undo(self, _: Any) -> None:
        """Forget what is drawn, or else the last selection."""
        if not self._is_drawing:
            self.polygons = self.polygons[:-1]
        self._end()
        self._show()

    def _show(self) -> None:
        """Tell the number of selections, and ask for a picture."""
        count = len(self.polygons)
        self._note.content = f"{count} selection{'s' if count > 1 else ''}." if count else ""
        self._changed()


def place_of(position: Any) -> Place:
    """Return a browser's `position` on the picture, fractions of width and height; the middle if it is invalid."""
    x, y = (number_in(value, 0, 1, 0.5) for value in position)
    return x, y


def is_same(first: Request, second: Request) -> bool:
    """Return whether the requests `first` and `second` are for pictures of the same size from the same camera."""
    moved = (first.pose.tensor() - second.pose.tensor()).abs().max()
    size = first.width, first.height, first.pose.fov
    return size == (second.width, second.height, second.pose.fov) and bool(moved <= STILL)


def segments(view: Request, corners: Sequence[Place], distance: float) -> np.ndarray:
    """Return the ends (C, 2, 3) float32 of the edges of an outline in the scene, at a `distance` from its camera.

    `corners` are columns and rows in the picture of the `view`.
    """
    columns, rows = torch.tensor(corners).T
    rays = view.camera().rays(torch.zeros(len(corners), dtype=torch.int64), columns, rows, 0.0, distance)
    points = (rays.origins + distance * rays.directions).numpy().astype(np.float32)
    return np.stack([points, np.roll(points, -1, axis=0)], axis=1)
