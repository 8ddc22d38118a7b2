"""The panel of one browser: its controls, and the request made from them and the browser's camera."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from nerfloom.viewer.crop_panel import CropPanel
from nerfloom.viewer.occupancy import shown_cells
from nerfloom.viewer.render_queue import RenderQueue
from nerfloom.viewer.request import OUTPUTS, Request, color_of, number_in, one_of, pose_of, size_of

if TYPE_CHECKING:
    import viser

SIZES = ("1024", "256", "512", "2048")
"""Longest sides of pictures, pixels; the first is the initial one."""
MEAN = "mean of all images"


class Panel:
    """Controls of one browser `client` for its picture, which `queue` draws."""

    def __init__(self, client: viser.ClientHandle, queue: RenderQueue) -> None:
        self._client, self._queue = client, queue
        scene = queue.loaded.model.scene
        both = [queue.loaded, *(() if queue.second is None else (queue.second,))]
        declared = [output.name for output in both[0].model.outputs if output in both[-1].model.outputs]
        has_photographs = queue.loaded.source is not None and not scene.warped
        self._outputs = [*OUTPUTS[:-1], *declared, *(OUTPUTS[-1:] if has_photographs else ())]
        gui = client.gui
        self._output = gui.add_dropdown("Output", self._outputs, initial_value="rgb")
        self._size = gui.add_dropdown(
            "Resolution", SIZES, initial_value=SIZES[0], hint="Longest side of the finished picture, pixels."
        )
        self._time = gui.add_slider("Time", 0.0, 1.0, 0.01, 0.0) if scene.moving else None
        self._appearance = self._add_appearance()
        self._overlay: Any = None
        if has_photographs:
            self._overlay = gui.add_slider(
                "Overlay", 0.0, 1.0, 0.01, 0.0, hint="Opacity of the photograph, where one was taken."
            )
        self._divider: Any = None
        if queue.second is not None:
            self._divider = gui.add_slider("Divider", 0.0, 1.0, 0.005, 0.5, hint="The second run is on its right.")
        with gui.add_folder("Background", expand_by_default=False):
            self._own_background = gui.add_checkbox("Own colour", False)
            self._background = gui.add_rgb("Colour", (255, 255, 255))
        self.crop = None if scene.warped else CropPanel(client, lambda: queue.loaded, self.request, self._ask)
        if shown_cells(queue.loaded.model, 1) is not None:
            self._cells = gui.add_checkbox("Occupied cells", False, hint="Outer cells of the sampled region")
            self._cells.on_update(lambda _: self._show_cells())
        handles = [self._output, self._size, self._time, self._appearance, self._own_background, self._background]
        for handle in [*handles, self._overlay, self._divider]:
            if handle is not None:
                handle.on_update(self._changed)
        client.camera.on_update(self._moved)

    def _add_appearance(self) -> Any:
        appearance = self._queue.loaded.model.appearance
        count = 0 if appearance is None else len(appearance.of_images())
        if not count:
            return None
        return self._client.gui.add_slider(
            "Appearance", -1, count - 1, 1, -1, hint=f"Number of a training image; -1: {MEAN}"
        )

    def next_output(self) -> None:
        """Show the next output of the list."""
        index = self._outputs.index(one_of(self._output.value, self._outputs))
        self._output.value = self._outputs[(index + 1) % len(self._outputs)]

    def show_time(self, time: float | None) -> None:
        """Show a moving scene at a `time` in [0, 1]; None for no change."""
        if self._time is not None and time is not None:
            self._time.value = time

    # -- requests ---------------------------------------------------------------------------------------------

    def _ask(self) -> None:
        self._queue.ask(self._client.client_id, self.request)

    def _changed(self, _: Any) -> None:
        self._ask()

    async def _moved(self, _: Any) -> None:  # in the server's own thread, so that cameras stay in order
        self._ask()

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
            crop=None if self.crop is None else self.crop.crop(),
            overlay=0.0 if self._overlay is None else number_in(self._overlay.value, 0, 1, 0),
            divider=None if self._divider is None else number_in(self._divider.value, 0, 1, 0.5),
        )

    def _image(self) -> int | None:
        chosen = -1 if self._appearance is None else int(number_in(self._appearance.value, -1, 1e7, -1))
        return None if chosen < 0 else chosen

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
