"""The viewpoint of one browser: its field of view, which way is up, and moves of its camera."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING

from torch import Tensor

from nerfloom.geometry.regions import Vector
from nerfloom.viewer.request import number_in, one_of, quaternion_of

if TYPE_CHECKING:
    import viser

FIRST_FOV = 50.0
"""Initial vertical field of view, degrees."""
SLIDER = (5.0, 140.0)
"""Range of the slider of the field of view, degrees."""
Move = Callable[[Tensor, float, "float | None"], None]
"""Function of a pose (3, 4), a field of view in radians and a time, if there is one, that moves a browser's camera."""
SCENE = "scene"
"""Entry of the list of up directions: the scene's."""
AXES: dict[str, Vector] = {
    "z": (0.0, 0.0, 1.0),
    "-z": (0.0, 0.0, -1.0),
    "y": (0.0, 1.0, 0.0),
    "-y": (0.0, -1.0, 0.0),
    "x": (1.0, 0.0, 0.0),
    "-x": (-1.0, 0.0, 0.0),
}
"""Up directions by name."""


class Viewpoint:
    """Controls of the browser `client` for its camera, in a scene with the direction `up`."""

    def __init__(self, client: viser.ClientHandle, up: Vector) -> None:
        self._client = client
        self._ups = {SCENE: up, **AXES}
        gui = client.gui
        self._fov = gui.add_slider("Field of view", *SLIDER, 0.1, FIRST_FOV, hint="Vertical field of view, degrees.")
        self._fov.on_update(lambda _: self._zoom())
        self._up = gui.add_dropdown("Up", list(self._ups), hint="The camera orbits about this axis.")
        self._up.on_update(lambda _: self.level())
        gui.add_button("Level", hint="Turn the horizon level: key L.").on_click(lambda _: self.level())

    def level(self) -> None:
        """Turn the camera about its view direction, so that the chosen direction is up in the picture."""
        with suppress(ValueError):  # a camera that has no direction
            self._client.camera.up_direction = self._ups[one_of(self._up.value, list(self._ups))]

    def move(self, pose: Tensor, fov: float) -> None:
        """Move the camera to `pose` (3, 4), OpenGL axes, with a vertical field of view `fov` in radians."""
        camera = self._client.camera
        with self._client.atomic():
            self._fov.value = round(number_in(math.degrees(fov), *SLIDER, FIRST_FOV), 1)
            camera.position = tuple(pose[:, 3].tolist())
            camera.wxyz = quaternion_of(pose.detach().cpu())  # keeps the orbit axis as close as possible
            camera.fov = float(fov)  # exactly, while the slider is rounded

    def _zoom(self) -> None:
        self._client.camera.fov = math.radians(number_in(self._fov.value, *SLIDER, FIRST_FOV))
