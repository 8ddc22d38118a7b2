"""Renderables that draw Gaussians, and fixed Gaussians, such as from a file."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import replace
from typing import ClassVar

import torch
from torch import Tensor

from nerfloom.cameras.view import View
from nerfloom.data.scene import Scene
from nerfloom.kernels.splats.project import SplatCamera
from nerfloom.renderable import Renderable
from nerfloom.rendering.outputs import NORMALS, Output
from nerfloom.rendering.rendered import Picture
from nerfloom.splats.drawing import DRAWN, draw_view, smallest_depth, splat_camera
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.look import Look
from nerfloom.splats.prepared_gaussians import PreparedGaussians
from nerfloom.splats.rasteriser import RASTERISER, Rasteriser


class DrawsGaussians(Renderable):
    """A renderable that draws Gaussians."""

    cameras: ClassVar[tuple[str, ...] | None] = DRAWN
    rasteriser: ClassVar[Rasteriser] = RASTERISER
    """The rasteriser."""
    _prepared: PreparedGaussians | None = None
    """The Gaussians of the last picture; set to None where they change."""

    @abstractmethod
    def gaussians(self, time: float | None = None) -> Gaussians:
        """Return the Gaussians at a time, without gradient.

        Args:
            time: in [0, 1]; None for a still scene.
        """

    @abstractmethod
    def look(self) -> Look:
        """Return the settings of drawing."""

    def lit(self, rgb: Tensor, transmittance: Tensor, background: Tensor, index: int | None) -> Tensor:
        """Return colours (H, W, 3) with the appearance of an image; unchanged by default.

        Args:
            rgb: (H, W, 3) drawn colours of all pixels.
            transmittance: (H, W) share of the background's light that arrives.
            background: (3,) colour behind everything.
            index: number of a training image; None for the current appearance.
        """
        return rgb

    @property
    def outputs(self) -> tuple[Output, ...]:
        """Return the normals, the shortest axes of Gaussians (`Picture.extras`)."""
        return (NORMALS,)

    def gaussians_in(self, view: View) -> Gaussians:
        """Return Gaussians that include all that a view shows, without gradient; by default all at its time."""
        return self.gaussians(view.time)

    def render_view(self, view: View, background: Tensor) -> Picture:
        return self.render_gaussians(self.gaussians_in(view), view, background)

    def render_gaussians(self, gaussians: Gaussians, view: View, background: Tensor) -> Picture:
        """Render the given Gaussians, such as a part of its own.

        Args:
            gaussians: Gaussians in the frame of the scene, at the time of the view.
            view, background: as in `render_view`.
        """
        camera = self._camera(view)
        picture = draw_view(gaussians, camera, view.stride, background, self.scene.far, self.rasteriser)
        return replace(picture, rgb=self.lit(picture.rgb, 1 - picture.accumulation, background, None))

    def render_rgb(self, view: View, background: Tensor) -> Tensor:
        if self._prepared is None or self._prepared.time != view.time:
            self._prepared = PreparedGaussians(self.gaussians(view.time), self.rasteriser, view.time)
        rgb, transmittance = self._prepared.draw(self._camera(view), view.stride, background)
        return self.lit(rgb, transmittance, background, None)

    def _camera(self, view: View) -> SplatCamera:
        return splat_camera(view.camera, smallest_depth(self.scene), self.look())


class DrawnGaussians(DrawsGaussians):
    """A renderable of fixed Gaussians.

    Args:
        gaussians: N Gaussians in the frame of the scene.
        scene: the scene that defines their frame.
    """

    def __init__(self, gaussians: Gaussians, look: Look, scene: Scene) -> None:
        self.scene, self._gaussians, self._look = scene, gaussians, look

    @property
    def device(self) -> torch.device:
        return self._gaussians.means.device

    def gaussians(self, time: float | None = None) -> Gaussians:
        """Return the Gaussians, which are the same at any `time`."""
        return self._gaussians

    def look(self) -> Look:
        return self._look
