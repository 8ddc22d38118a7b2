"""The photographs' cameras in the scene of one browser, with thumbnails that are read when shown."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from nerfloom.viewer.markdown import plain
from nerfloom.viewer.photographs import Photographs
from nerfloom.viewer.request import number_in, quaternion_of
from nerfloom.viewer.viewpoint import Move

if TYPE_CHECKING:
    import viser

ROOM = "/photographs"
"""Name of the cameras in the scene."""
COLOR = (60, 180, 90)
"""Colour of the cameras, which is seen before light and dark scenes."""
SIZE = 0.06
"""Size of a camera in the scene, as a fraction of the cameras' spread."""


class CameraPanel:
    """Controls of one browser `client` for the cameras of `photographs`; `move` moves the browser's camera."""

    def __init__(self, client: viser.ClientHandle, photographs: Photographs, move: Move) -> None:
        self._client, self._photographs, self._move = client, photographs, move
        self._generation = 0
        self._frusta: dict[int, Any] = {}
        self._shown = client.gui.add_checkbox(
            "Show cameras", False, hint="Cameras of the training images; click on one to go there."
        )
        self._number = client.gui.add_number(
            "Photograph", 0, min=0, step=1, hint="Index of a training image, from 0; its name is shown below."
        )
        self._go = client.gui.add_button("Go to the photograph")
        self._note = client.gui.add_markdown("")
        self._shown.on_update(lambda _: self._show())
        self._go.on_click(lambda _: self.step(0))

    def _show(self) -> None:
        """Add or remove the cameras; their thumbnails follow one by one."""
        self._generation += 1
        generation = self._generation
        self._frusta = {}
        if self._shown.value is not True:
            self._client.scene.remove_by_name(ROOM)
            return
        chosen, cameras = self._photographs.chosen(), self._photographs.cameras
        if cameras is None:
            self._note.content = "The photographs cannot be read."
            return
        self._client.scene.add_frame(ROOM, show_axes=False)
        places = cameras.camera_to_worlds[:, :, 3]
        size = SIZE * (float((places - places.mean(0)).norm(dim=-1).max()) or 1.0)
        handles: dict[int, Any] = {}
        for index in chosen:
            pose = cameras.camera_to_worlds[index]
            handles[index] = self._client.scene.add_camera_frustum(
                f"{ROOM}/{index}",
                fov=self._photographs.fov(index),
                aspect=float(cameras.widths[index]) / float(cameras.heights[index]),
                scale=size,
                color=COLOR,
                thickness=1.5,
                thickness_units="screen",
                wxyz=quaternion_of(pose),
                position=pose[:, 3].tolist(),
            )
            handles[index].on_click(lambda _, index=index: self.visit(index))
        self._frusta = handles
        self._uncover(self._client.camera.position)
        self._note.content = f"{len(chosen)} of {len(cameras)} cameras"
        for index, handle in handles.items():
            if generation != self._generation:  # cameras hidden meanwhile, or browser gone
                return
            if (small := self._photographs.thumbnail(index)) is not None:
                handle.image = small

    def _uncover(self, place: Iterable[float]) -> None:
        """Hide the cameras at the `place` of the browser's camera: their thumbnails would cover its picture."""
        for frustum in self._frusta.values():
            frustum.visible = math.dist(frustum.position, place) > frustum.scale

    def close(self) -> None:
        """Stop reading thumbnails when the browser has left."""
        self._generation += 1

    def step(self, count: int) -> None:
        """Move the browser's camera to the photograph `count` after the one with the index that is shown."""
        cameras = self._photographs.cameras
        if cameras is None:
            self._note.content = "The photographs cannot be read."
            return
        shown = int(number_in(self._number.value, 0, len(cameras) - 1, 0))
        self.visit((shown + count) % len(cameras))

    def visit(self, index: int) -> None:
        """Move the browser's camera to the photograph `index`."""
        self._number.value = index
        photographs = self._photographs
        self._move(photographs.pose(index), photographs.fov(index), photographs.time(index))
        self._uncover(photographs.pose(index)[:, 3].tolist())
        self._note.content = f"photograph {index}: {plain(photographs.name(index))}"
