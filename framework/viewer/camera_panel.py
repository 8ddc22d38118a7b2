"""The cameras of the photographs in the scene of one browser, with small pictures that are read when they are shown."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from torch import Tensor

from nerfloom.viewer.photographs import Photographs
from nerfloom.viewer.request import number_in, quaternion_of

if TYPE_CHECKING:
    import viser

ROOM = "/photographs"
"""Name of the cameras in the scene."""
SIZE = 0.06
"""Size of a camera in the scene, as a fraction of the cameras' spread."""


class CameraPanel:
    """Controls of one browser for the photographs' cameras.

    Args:
        client: the browser.
        photographs: the training images.
    """

    def __init__(self, client: viser.ClientHandle, photographs: Photographs) -> None:
        self._client, self._photographs = client, photographs
        self._generation = 0
        self._shown = client.gui.add_checkbox(
            "Show cameras", False, hint="Cameras of the training images; a click on one of them goes there."
        )
        self._number = client.gui.add_number(
            "Photograph", 0, min=0, step=1, hint="Number of a training image, from 0; its name is shown below."
        )
        self._go = client.gui.add_button("Go to the photograph")
        self._note = client.gui.add_markdown("")
        self._shown.on_update(lambda _: self._show())
        self._go.on_click(lambda _: self._visit())

    def _show(self) -> None:
        """Add or remove the cameras; their pictures follow one by one."""
        self._generation += 1
        generation = self._generation
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
        handles = {}
        for index in chosen:
            pose = self._photographs.pose(index)
            handles[index] = self._client.scene.add_camera_frustum(
                f"{ROOM}/{index}",
                fov=self._photographs.fov(index),
                aspect=float(cameras.widths[index]) / float(cameras.heights[index]),
                scale=size,
                thickness=1.0,
                thickness_units="screen",
                wxyz=quaternion_of(pose),
                position=pose[:, 3].tolist(),
            )
            handles[index].on_click(lambda _, index=index: self.visit(index))
        self._note.content = f"{len(chosen)} of {len(cameras)} cameras"
        for index, handle in handles.items():
            if generation != self._generation:  # hidden meanwhile, or the browser has left
                return
            if (small := self._photographs.thumbnail(index)) is not None:
                handle.image = small

    def close(self) -> None:
        """Stop reading pictures: the browser has left."""
        self._generation += 1

    def _visit(self) -> None:
        cameras = self._photographs.cameras
        if cameras is None:
            self._note.content = "The photographs cannot be read."
            return
        self.visit(int(number_in(self._number.value, 0, len(cameras) - 1, 0)))

    def visit(self, index: int) -> None:
        """Move the browser's camera to that of a photograph, by its `index`."""
        move_camera(self._client, self._photographs.pose(index), self._photographs.fov(index))
        self._note.content = f"photograph {index}: {plain(self._photographs.name(index))}"


def move_camera(client: Any, pose: Tensor, fov: float) -> None:
    """Move a browser's camera.

    Args:
        client: the browser.
        pose: (3, 4) camera-to-scene, OpenGL axes.
        fov: vertical field of view, radians.
    """
    with client.atomic():
        client.camera.position = tuple(pose[:, 3].tolist())
        client.camera.wxyz = quaternion_of(pose.detach().cpu())  # keeps the axis of turning as close as it can
        client.camera.fov = float(fov)


def plain(text: str) -> str:
    """Return a `text` without marks of Markdown, which the panel would show."""
    return "".join(letter if letter.isalnum() or letter in "-. " else "-" for letter in text)
