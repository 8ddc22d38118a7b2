"""The panel of one browser: its controls, and the request made from them and the browser's camera."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from nerfloom.evaluation.appearance import appearance_of
from nerfloom.viewer.crop import meaning
from nerfloom.viewer.occupancy import shown_cells
from nerfloom.viewer.render_queue import RenderQueue
from nerfloom.viewer.request import (
    MAX_COORDINATE,
    OUTPUTS,
    Crop,
    Request,
    color_of,
    corner_of,
    number_in,
    one_of,
    pose_of,
    size_of,
)

if TYPE_CHECKING:
    import viser

SIZES = ("1024", "256", "512", "2048")
"""Longest sides of pictures, pixels; the first is the initial one."""
MEAN = "mean of all images"


class Panel:
    """Controls of one browser for its picture.

    Args:
        client: the browser.
        queue: draws its pictures.
    """

    def __init__(self, client: viser.ClientHandle, queue: RenderQueue) -> None:
        self._client, self._queue = client, queue
        scene = queue.loaded.model.scene
        declared = [output.name for output in queue.loaded.model.outputs]
        has_photographs = queue.loaded.source is not None and not scene.warped
        self._outputs = [*OUTPUTS[:-1], *declared, *(OUTPUTS[-1:] if has_photographs else ())]
        gui = client.gui
        self._output = gui.add_dropdown("Output", self._outputs, initial_value="rgb")
        self._size = gui.add_dropdown(
            "Resolution", SIZES, initial_value=SIZES[0], hint="Longest side of the finished picture, pixels."
        )
        self._time = gui.add_slider("Time", 0.0, 1.0, 0.01, 0.0) if scene.moving else None
        self._appearance = self._add_appearance()
        with gui.add_folder("Background", expand_by_default=False):
            self._own_background = gui.add_checkbox("Own colour", False)
            self._background = gui.add_rgb("Colour", (255, 255, 255))
        self._crop_values: list[Any] = []
        if not scene.warped:
            self._add_crop()
        if shown_cells(queue.loaded.model, 1) is not None:
            self._cells = gui.add_checkbox("Occupied cells", False, hint="Outer cells of the sampled region")
            self._cells.on_update(lambda _: self._show_cells())
        handles = [self._output, self._size, self._time, self._appearance, self._own_background, self._background]
        for handle in [*handles, *self._crop_values]:
            if handle is not None:
                handle.on_update(self._changed)
        client.camera.on_update(self._moved)

    def _add_appearance(self) -> Any:
        appearance = appearance_of(self._queue.loaded.model)
        if appearance is None or not len(appearance.vectors):
            return None
        return self._client.gui.add_slider(
            "Appearance", -1, len(appearance.vectors) - 1, 1, -1, hint=f"Number of a training image; -1: {MEAN}"
        )

    def _add_crop(self) -> None:
        model, gui = self._queue.loaded.model, self._client.gui
        low, high = (tuple(corner) for corner in model.scene.box.cpu().tolist())
        step = float((model.scene.box[1] - model.scene.box[0]).max()) / 200
        with gui.add_folder("Crop", expand_by_default=False):
            gui.add_markdown(meaning(model))
            self._crop_values = [
                gui.add_checkbox("Crop", False),
                gui.add_vector3("Lowest corner", low, step=step),
                gui.add_vector3("Highest corner", high, step=step),
                gui.add_number("Near", 0.0, min=0.0, step=step, hint="Distance from the camera, scene units"),
                gui.add_number("Far", round(float(model.scene.far), 3), min=0.0, step=step),
            ]

    # -- requests ---------------------------------------------------------------------------------------------

    def _changed(self, _: Any) -> None:
        self._queue.ask(self._client.client_id, self.request)

    async def _moved(self, _: Any) -> None:  # in the server's own thread, so that cameras stay in order
        self._queue.ask(self._client.client_id, self.request)

    def request(self, last: Request | None = None) -> Request | None:
        """Return the browser's current request; the `last` request if its camera is invalid."""
        camera = self._client.camera
        pose = pose_of(camera.wxyz, camera.position, camera.fov)
        if pose is None:
            return last
        longest = int(one_of(self._size.value, SIZES))
        width, height = size_of(camera.image_width, camera.image_height, longest)
        return Request(
            pose,
            width,
            height,
            output=one_of(self._output.value, self._outputs),
            time=None if self._time is None else number_in(self._time.value, 0, 1, 0),
            appearance=self._image(),
            background=color_of(self._background.value) if self._own_background.value is True else None,
            crop=self._crop(),
        )

    def _image(self) -> int | None:
        chosen = -1 if self._appearance is None else int(number_in(self._appearance.value, -1, 1e7, -1))
        return None if chosen < 0 else chosen

    def _crop(self) -> Crop | None:
        if not self._crop_values or self._crop_values[0].value is not True:
            return None
        _, low, high, near, far = (handle.value for handle in self._crop_values)
        first, second = corner_of(low, (-1, -1, -1)), corner_of(high, (1, 1, 1))
        if not all(a < b for a, b in zip(first, second, strict=True)):
            return None
        begin, end = number_in(near, 0, MAX_COORDINATE, 0), number_in(far, 0, MAX_COORDINATE, MAX_COORDINATE)
        return Crop((first, second), begin, end if end > begin else math.inf)

    def time(self) -> float | None:
        """Return the displayed time; None for a static scene."""
        return None if self._time is None else number_in(self._time.value, 0, 1, 0)

    # -- the scene --------------------------------------------------------------------------------------------

    def _show_cells(self) -> None:
        name = "/occupied_cells"
        if self._cells.value is not True:
            self._client.scene.remove_by_name(name)
            return
        found = shown_cells(self._queue.loaded.model)
        if found is not None and len(found[0]):
            points, edge = found
            low, high = points.amin(0), points.amax(0)
            colors = (40 + 200 * (points - low) / (high - low).clamp(min=1e-9)).numpy().astype(np.uint8)
            self._client.scene.add_point_cloud(
                name, points.numpy().astype(np.float32), colors, point_size=0.3 * edge, precision="float32"
            )
