"""The page: parts shared by all browsers, and a panel for each browser."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from nerfloom.cameras.poses import looked_at
from nerfloom.geometry.regions import Vector
from nerfloom.renderable import training_poses
from nerfloom.viewer.browser import Browser
from nerfloom.viewer.camera_panel import CameraPanel
from nerfloom.viewer.commands import Commands
from nerfloom.viewer.crop_panel import CropPanel
from nerfloom.viewer.export_panel import ExportPanel
from nerfloom.viewer.floater_panel import FloaterPanel
from nerfloom.viewer.floaters import can_find
from nerfloom.viewer.measure_panel import MeasurePanel
from nerfloom.viewer.panel import Panel
from nerfloom.viewer.path_panel import PathPanel
from nerfloom.viewer.photographs import Photographs
from nerfloom.viewer.render_queue import RenderQueue
from nerfloom.viewer.reports import curve, heading
from nerfloom.viewer.viewpoint import FIRST_FOV, Viewpoint

if TYPE_CHECKING:
    import viser


class Key(NamedTuple):
    """A key of the page, and its action. Ctrl-K lists all keys."""

    key: str
    """Upper-case letter other than W, A, S, D, Q and E, which move the camera."""
    label: str
    """Name of the action."""
    action: Callable[[], object]
    """The action."""


class Page:
    """Panels and pictures of a server's browsers.

    Args:
        server: the server.
        queue: draws the pictures.
        photos: the training images.
        commands: the commands that browsers start, ns-render and ns-export; None if they may not.
    """

    def __init__(
        self, server: viser.ViserServer, queue: RenderQueue, photos: Photographs, commands: Commands | None
    ) -> None:
        self._server, self._queue, self._photographs = server, queue, photos
        self._commands = commands
        self._panels: dict[int, list[Any]] = {}
        self._curve: Any = None
        self._heading = server.gui.add_markdown("")
        if queue.second is not None:
            server.gui.add_markdown(f"right of the divider:  \n{heading(queue.second)}")
        with server.gui.add_folder("Learning curve", expand_by_default=False):
            self._place_of_curve = server.gui.add_folder(None)
        self.refresh()
        self._up = self._place_camera()
        server.on_client_connect(self._welcome)
        server.on_client_disconnect(self._farewell)

    def _welcome(self, client: viser.ClientHandle) -> None:
        """Give a browser its panel and its first picture."""

        def show(image: np.ndarray, quality: int) -> None:
            client.scene.set_background_image(image, format="jpeg", jpeg_quality=quality)
            client.flush()

        number, queue = client.client_id, self._queue
        tabs = client.gui.add_tab_group()
        with tabs.add_tab("View"):
            panel = Panel(client, queue)
            viewpoint = Viewpoint(client, self._up)
        queue.add(number, Browser(show))
        queue.ask(number, panel.request)
        keys = [Key("L", "Level the horizon", viewpoint.level), Key("O", "Next output", panel.next_output)]
        self._panels[number] = []
        if panel.crop is not None:
            self._panels[number], others = self._add_tabs(client, tabs, panel, panel.crop, viewpoint)
            keys += others
        _add_keys(client, keys)
        if number not in self._server.get_clients():  # the browser left before it was set up
            self._farewell(client)

    def _add_tabs(
        self, client: viser.ClientHandle, tabs: Any, panel: Panel, crop: CropPanel, viewpoint: Viewpoint
    ) -> tuple[list[Any], list[Key]]:
        """Add the tabs of a scene with lengths. Return the parts to close when the browser leaves, and the keys."""
        queue, parts, keys = self._queue, list[Any](), [Key("C", "Crop on or off", crop.toggle)]

        def move(pose: Tensor, fov: float, time: float | None) -> None:
            viewpoint.move(pose, fov)
            panel.show_time(time)

        if queue.loaded.source is not None:
            with tabs.add_tab("Photos"):
                cameras = CameraPanel(client, self._photographs, move)
                if can_find(queue.loaded):
                    FloaterPanel(client, queue, panel.request)
            parts.append(cameras)
            keys += [
                Key("N", "Next photograph", lambda: cameras.step(1)),
                Key("P", "Previous photograph", lambda: cameras.step(-1)),
            ]
        with tabs.add_tab("Path"):
            parts.append(PathPanel(client, lambda: queue.loaded, panel.request, move, self._commands))
        with tabs.add_tab("Measure"):
            MeasurePanel(client, queue, panel.request)
        if self._commands is not None:
            with tabs.add_tab("Export"):
                ExportPanel(client, lambda: queue.loaded, panel.request, crop, self._commands)
        return parts, keys

    def _farewell(self, client: viser.ClientHandle) -> None:
        self._queue.remove(client.client_id)
        for part in self._panels.pop(client.client_id, ()):
            part.close()

    def refresh(self) -> None:
        """Update the run's step, PSNR and learning curve."""
        loaded = self._queue.loaded
        content = heading(loaded)
        if content != self._heading.content:
            self._heading.content = content
        if loaded.is_run:
            self.show_curve(*curve(loaded.folder))

    def show_curve(self, seconds: list[float], psnr: list[float]) -> None:
        """Show a learning curve: `psnr` of held-out images, dB, after `seconds` of training."""
        if len(seconds) < 2:
            return
        data = (np.array(seconds), np.array(psnr))
        if self._curve is None:
            series: Any = ({"label": "seconds"}, {"label": "PSNR, dB", "stroke": "#2060c0", "width": 2})
            scales: Any = {"x": {"time": False}}
            with self._place_of_curve:
                self._curve = self._server.gui.add_uplot(data, series, scales=scales, aspect=1.6)
        elif len(self._curve.data[0]) != len(seconds):
            self._curve.data = data

    def _place_camera(self) -> Vector:
        """Place the initial camera at the first training camera, with the same view direction; return the up axis."""
        model = self._queue.loaded.model
        scene, poses = model.scene, training_poses(model)
        if poses is None or not len(poses) or scene.warped:
            center, size = scene.box.mean(0), float((scene.box[1] - scene.box[0]).norm())
            position = center + torch.tensor([0.0, -0.6, 0.3]).to(center) * size
            up = torch.tensor([0.0, 0.0, 1.0])
            if scene.warped and poses is not None and len(poses):
                position, center, up = poses[0, :, 3], poses[0, :, 3] - poses[0, :, 2], poses[0, :, 1]
        else:
            pose, mean = poses[0].cpu(), poses[:, :, 1].mean(0).cpu()
            level = scene.z_is_up or float(mean[2]) > 0.5 * float(mean.norm())
            up = torch.tensor([0.0, 0.0, 1.0]) if level else mean
            seen = looked_at(poses) if scene.unbounded else None  # a capture orbits the point that its cameras look at
            middle = (scene.box.mean(0).cpu() if seen is None else seen.float()) - pose[:, 3]
            distance = max(float(-(middle @ pose[:, 2])), 0.1 * float(middle.norm()), 1e-3)
            position, center = pose[:, 3], pose[:, 3] - distance * pose[:, 2]
        x, y, z = up.tolist()
        self._server.scene.set_up_direction((x, y, z))
        camera = self._server.initial_camera
        camera.position, camera.look_at = tuple(position.tolist()), tuple(center.tolist())
        camera.fov = math.radians(FIRST_FOV)
        return x, y, z

    def close(self) -> None:
        """End everything that browsers have started."""
        for number in list(self._panels):
            for part in self._panels.pop(number, ()):
                part.close()
        if self._commands is not None:
            self._commands.close()


def _add_keys(client: viser.ClientHandle, keys: Iterable[Key]) -> None:
    """Make keys known to a browser."""
    for key in keys:
        client.gui.add_command(key.label, hotkey=key.key).on_trigger(lambda _, action=key.action: action())
