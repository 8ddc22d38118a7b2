"""The crop of one browser: a box with its corners as numbers and an arrow at each face, and drawn selections."""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable
from functools import partial
from itertools import combinations, product
from typing import TYPE_CHECKING, Any

import numpy as np

from nerfloom.base.console import say
from nerfloom.geometry.regions import Box, Region, Vector, write_regions
from nerfloom.training.loaded import Loaded
from nerfloom.viewer.crop import meaning
from nerfloom.viewer.request import MAX_COORDINATE, Crop, Request, corner_of, number_in
from nerfloom.viewer.select_panel import SelectPanel

if TYPE_CHECKING:
    import viser

ROOM = "/crop"
"""Name of the edges and the arrows in the scene."""
COLOR = (0, 160, 255)
"""Colour of the edges."""
ARROW = 70.0
"""Length of an arrow, pixels."""
FILE = "crop.yaml"
"""Name of the regions' file in the folder of a run or a file."""
Face = tuple[int, int]
"""Axis of a face's normal, and 0 for the face of the minimum corner or 1 for the maximum corner."""
FACES: tuple[Face, ...] = tuple(product(range(3), range(2)))
"""All faces."""


class CropPanel:
    """Controls of one browser for its crop.

    All callbacks that draw run in the server's own thread, so that they stay in order.

    Args:
        client: the browser.
        loaded: function that returns the model and its run.
        request: function that returns the browser's request; None if its camera is invalid.
        changed: function that is called when the crop has changed.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        loaded: Callable[[], Loaded],
        request: Callable[[], Request | None],
        changed: Callable[[], None],
    ) -> None:
        self._client, self._loaded, self._changed = client, loaded, changed
        self._edges: Any = None
        self._arrows: dict[Face, Any] = {}
        self._dragged: Face | None = None
        model, gui = loaded().model, client.gui
        low, high = (tuple(corner) for corner in model.scene.box.cpu().tolist())
        self._thinnest = step = float((model.scene.box[1] - model.scene.box[0]).max()) / 200
        with gui.add_folder("Crop", expand_by_default=False):
            gui.add_markdown(meaning(model))
            self._cropping = gui.add_checkbox("Crop", False, hint="Key C.")
            self._boxed = gui.add_checkbox("Show the box", True, hint="Drag the arrows at its faces.")
            self._low = gui.add_vector3("Lowest corner", low, step=step)
            self._high = gui.add_vector3("Highest corner", high, step=step)
            hint = "Distance from the camera, scene units."
            self._near = gui.add_number("Near", 0.0, min=0.0, step=step, hint=hint)
            self._far = gui.add_number("Far", round(float(model.scene.far), 3), min=0.0, step=step, hint=hint)
            self._selected = SelectPanel(client, request, changed, distance=20 * step)
            gui.add_button("Save the crop", hint=f"{FILE} in the folder of the run or file.").on_click(
                lambda _: self._save()
            )
            self._note = gui.add_markdown("")
        for handle in (self._cropping, self._boxed):
            handle.on_update(self._switched)
        for handle in (self._low, self._high, self._near, self._far):
            handle.on_update(self._resized)

    def toggle(self) -> None:
        """Switch the box on or off."""
        self._cropping.value = self._cropping.value is not True

    def crop(self) -> Crop | None:
        """Return the crop; None if there are no selections, and the box is off or empty."""
        box, polygons = self._box() if self._cropping.value is True else None, self._selected.polygons
        if box is None:
            return Crop(polygons=polygons) if polygons else None
        near = number_in(self._near.value, 0, MAX_COORDINATE, 0)
        far = number_in(self._far.value, 0, MAX_COORDINATE, MAX_COORDINATE)
        return Crop(box, near, far if far > near else math.inf, polygons)

    def _box(self) -> Box | None:
        """Return the box, in the frame of the scene; None if it is empty."""
        low, high = corner_of(self._low.value, (-1, -1, -1)), corner_of(self._high.value, (1, 1, 1))
        return Box(low, high) if all(a < b for a, b in zip(low, high, strict=True)) else None

    # -- the scene --------------------------------------------------------------------------------------------

    async def _switched(self, _: Any) -> None:
        self._draw()
        self._changed()

    async def _resized(self, _: Any) -> None:
        if self._arrows:
            self._place()
        else:
            self._draw()
        self._changed()

    def _draw(self) -> None:
        """Draw the edges and the arrows, if the box is shown."""
        scene, box = self._client.scene, self._box()
        scene.remove_by_name(ROOM)
        self._arrows, self._dragged = {}, None
        if box is None or not (self._cropping.value is True and self._boxed.value is True):
            return
        scene.add_frame(ROOM, show_axes=False)
        color = np.array(COLOR, np.uint8)
        self._edges = scene.add_line_segments(
            f"{ROOM}/edges", edges(box), color, thickness=2.0, thickness_units="screen"
        )
        for axis, side in FACES:
            arrow = scene.add_transform_controls(
                f"{ROOM}/{'xyz'[axis]}{side}",
                scale=ARROW,
                fixed=True,
                line_width=4.0,
                active_axes=(axis == 0, axis == 1, axis == 2),
                disable_sliders=True,
                disable_rotations=True,
                depth_test=False,
                wxyz=outward((axis, side)),
                position=middle(box, (axis, side)),
            )
            arrow.on_update(partial(self._drag, (axis, side)))
            self._arrows[axis, side] = arrow

    def _place(self) -> None:
        """Move the edges and the arrows to the box; the arrow that is dragged is where the pointer is."""
        box = self._box()
        if box is None or not self._arrows:
            return
        self._edges.points = edges(box)
        for face, arrow in self._arrows.items():
            if face != self._dragged:
                arrow.position = middle(box, face)

    async def _drag(self, face: Face, event: Any) -> None:
        """Move a face to its arrow."""
        box, (axis, side) = self._box(), face
        if box is None:
            return
        self._dragged = None if event.phase == "end" else face
        place = corner_of(event.target.position, middle(box, face))[axis]
        corner = (self._low, self._high)[side]
        corner.value = dragged(box, face, place, self._thinnest)
        if self._dragged is None:
            self._place()

    # -- its file ---------------------------------------------------------------------------------------------

    def regions(self) -> list[Region]:
        """Return the box and the selections in the frame and unit of exports; none if nothing is cropped."""
        crop = self.crop()
        if crop is None:
            return []
        crop = crop.moved(*self._loaded().placement.original_similarity())
        return [*(() if crop.box is None else (crop.box,)), *crop.polygons]

    def _save(self) -> None:
        """Write the box and the selections to the folder of the run or file."""
        regions, file = self.regions(), self._loaded().folder / FILE
        if not regions:
            self._note.content = "There is no crop: it is off, or a lowest coordinate is not below the highest."
            return
        try:
            write_regions(file, regions)
        except OSError as error:
            self._note.content = f"Cannot write {FILE}: {error.strerror or error}"
            return
        say(f"viewer: saved {file}; ns-export and ns-edit take it: --region {shlex.quote(str(file))}")
        self._note.content = f"Saved {FILE}; ns-export and ns-edit take it as --region."


def edges(box: Box) -> np.ndarray:
    """Return the ends (12, 2, 3) float32 of the edges of a `box` that is parallel to the axes."""
    sides = np.array(list(product((0, 1), repeat=3)))
    corners = np.take_along_axis(np.array([box.low, box.high]), sides, axis=0)
    pairs = [pair for pair in combinations(range(8), 2) if np.abs(sides[pair[0]] - sides[pair[1]]).sum() == 1]
    return corners[np.array(pairs)].astype(np.float32)


def middle(box: Box, face: Face) -> Vector:
    """Return the centre of a `face`, axis and side, of a `box` that is parallel to the axes."""
    x, y, z = ((low + high) / 2 for low, high in zip(box.low, box.high, strict=True))
    return replaced((x, y, z), face[0], (box.low, box.high)[face[1]][face[0]])


def dragged(box: Box, face: Face, place: float, thinnest: float) -> Vector:
    """Return the corner of a box after a face has been dragged.

    Args:
        box: a box that is parallel to the axes.
        face: axis and side.
        place: new coordinate of the face along that axis.
        thinnest: minimum length of an edge. One that is shorter already may stay so, or the face would jump.
    """
    axis, side = face
    low, high = box.low[axis], box.high[axis]
    least = min(thinnest, high - low)
    if side:
        return replaced(box.high, axis, max(place, low + least))
    return replaced(box.low, axis, min(place, high - least))


def outward(face: Face) -> tuple[float, float, float, float]:
    """Return the quaternion w, x, y, z of an arrow along its axis that points out of the box at a `face`."""
    axis, side = face
    if side:
        return 1.0, 0.0, 0.0, 0.0
    x, y, z = (float(other == (axis + 1) % 3) for other in range(3))  # half a turn about another axis
    return 0.0, x, y, z


def replaced(corner: Vector, axis: int, value: float) -> Vector:
    """Return a `corner` with another `value` along an `axis`."""
    x, y, z = (value if index == axis else old for index, old in enumerate(corner))
    return x, y, z
