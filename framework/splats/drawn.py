"""Gaussians that can be rendered but not trained, such as those of a file."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from nerfloom.cameras.view import View
from nerfloom.data.scene import Scene
from nerfloom.renderable import Renderable
from nerfloom.rendering.outputs import NORMALS, Output
from nerfloom.rendering.rendered import Picture
from nerfloom.splats.drawing import DRAWN, draw_view, smallest_depth, splat_camera
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.look import Look
from nerfloom.splats.rasteriser import RASTERISER
from nerfloom.splats.redrawn import Redrawn


class DrawnGaussians(Renderable):
    """A renderable of fixed Gaussians.

    Args:
        gaussians: N Gaussians in the frame of the scene.
        look: the settings of drawing.
        scene: the scene that defines their frame.
    """

    cameras: ClassVar[tuple[str, ...] | None] = DRAWN

    def __init__(self, gaussians: Gaussians, look: Look, scene: Scene) -> None:
        self.scene = scene
        self._look, self._redrawn = look, Redrawn(gaussians, RASTERISER)

    @property
    def device(self) -> torch.device:
        return self._redrawn.gaussians.means.device

    @property
    def outputs(self) -> tuple[Output, ...]:
        return (NORMALS,)

    def gaussians(self, time: float | None = None) -> Gaussians:
        """Return the Gaussians, which are the same at any `time`."""
        return self._redrawn.gaussians

    def look(self) -> Look:
        """Return the settings of drawing."""
        return self._look

    def render_view(self, view: View, background: Tensor) -> Picture:
        return self.render_gaussians(self.gaussians(), view, background)

    def render_gaussians(self, gaussians: Gaussians, view: View, background: Tensor) -> Picture:
        """Render the given Gaussians, such as a part of its own.

        Args:
            gaussians: Gaussians in the frame of the scene.
            view, background: as in `render_view`.
        """
        camera = splat_camera(view.camera, smallest_depth(self.scene), self._look)
        return draw_view(gaussians, camera, view.stride, background, self.scene.far)

    def render_rgb(self, view: View, background: Tensor) -> Tensor:
        camera = splat_camera(view.camera, smallest_depth(self.scene), self._look)
        return self._redrawn.colors(camera, view.stride, background)
