"""A renderable of Gaussians in a tree of levels, which reads the chunks that a view needs from disk."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import torch
from torch import Tensor

from nerfloom.base.console import say
from nerfloom.base.errors import ConfigError
from nerfloom.cameras.moved import moved_cameras
from nerfloom.cameras.poses import Placement
from nerfloom.cameras.view import View, every
from nerfloom.data.scene import Scene
from nerfloom.kernels.splats.project import RECORD, Record, SplatCamera
from nerfloom.levels.chunks import ChunkCache
from nerfloom.levels.cut import Cut, cut_of
from nerfloom.levels.files import LevelsFile
from nerfloom.levels.on_image import in_view, sizes_on_image, tangents
from nerfloom.levels.settings import DetailSettings
from nerfloom.renderable import Renderable
from nerfloom.rendering.outputs import NORMALS, Output
from nerfloom.rendering.rendered import Picture
from nerfloom.splats.drawing import DRAWN, picture_of, smallest_depth, splat_camera
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.rasteriser import RASTERISER, Projected, Rasteriser

DRAWN_SIZE = 192
"""Memory of a drawn Gaussian besides its parameters, bytes: its record, twice while records are joined, and its entries
in lists of tiles."""
NEWS = 1.5
"""Minimum ratio of a level error to the last reported one for a new report."""


class DrawnLevels(Renderable):
    """A renderable of a file of levels. Chunks stay in the frame of the file; the camera of each view is moved to it.

    Args:
        file: the file.
        placement: placement of the file's coordinates in the scene.
        scene: the scene.
        device: the device that draws.
        settings: the detail of pictures, and the memory for it.

    Raises:
        ConfigError: if the memory does not suffice for a single chunk.
    """

    cameras: ClassVar[tuple[str, ...] | None] = DRAWN
    rasteriser: ClassVar[Rasteriser] = RASTERISER
    """The rasteriser."""

    def __init__(
        self, file: LevelsFile, placement: Placement, scene: Scene, device: torch.device, settings: DetailSettings
    ) -> None:
        self.file, self.scene, self.settings = file, scene.to(device), settings
        self._reported = settings.level_error
        self.placement = placement
        """Placement of the file's coordinates in the scene."""
        self._device, self._to_file = device, placement.original_similarity()
        each, largest = file.gaussian_size, int(file.nodes.counts.max())
        self.most = int(settings.memory_limit * 1e6 / (each + DRAWN_SIZE))
        """Maximum number of Gaussians of a picture."""
        if self.most < largest:
            least = largest * (each + DRAWN_SIZE) / 1e6
            raise ConfigError(
                f"--memory-limit is {settings.memory_limit:g} MB, and a chunk of {file.path} needs {least:.4g} MB; "
                "raise it, or export the file with a smaller --chunk-size"
            )
        self.chunks = ChunkCache(self._read, (each * file.nodes.counts).tolist(), each * self.most)
        """The chunks in memory."""

    @property
    def device(self) -> torch.device:
        return self._device

    @property
    def outputs(self) -> tuple[Output, ...]:
        return (NORMALS,)

    @torch.no_grad()
    def render_view(self, view: View, background: Tensor) -> Picture:
        rotation, scale, _ = self._to_file
        camera, shown, error = self._shown(view)
        picture = picture_of(shown, camera, view.stride, background, scale * self.scene.far, self.rasteriser)
        normals = picture.extras[NORMALS.name] @ rotation.to(picture.rgb)
        depth, median = picture.depth / scale, picture.median_depth / scale
        extras = {NORMALS.name: normals}
        return replace(picture, depth=depth, median_depth=median, extras=extras, level_error=error)

    @torch.no_grad()
    def render_rgb(self, view: View, background: Tensor) -> Tensor:
        camera, shown, _ = self._shown(view)
        return every(self.rasteriser.draw(shown, camera, background).image, view.stride)

    def cut(self, view: View) -> Cut:
        """Return the nodes that are drawn for a `view`, in the frame of the scene."""
        return self._camera_and_cut(view)[1]

    def _camera_and_cut(self, view: View) -> tuple[SplatCamera, Cut]:
        rotation, scale, shift = self._to_file
        moved, look, nodes = moved_cameras(view.camera, rotation, scale, shift), self.file.look, self.file.nodes
        near = scale * smallest_depth(self.scene)
        camera = splat_camera(moved, near, look)
        sizes = sizes_on_image(nodes, camera, near)
        seen = in_view(nodes.boxes, camera, tangents(moved, look.blur))
        return camera, cut_of(nodes, sizes, seen, self.settings.level_error, self.most)

    def _shown(self, view: View) -> tuple[SplatCamera, Projected, float]:
        """Return the camera of a view in the frame of the file, the Gaussians on its image, and their level error."""
        camera, cut = self._camera_and_cut(view)
        self._report(cut)
        # An invisible record comes first, so that there is one even if nothing is in view.
        records = [torch.zeros(1, RECORD, device=self.device)]
        keys = [torch.ones(1, device=self.device)]
        for chunk in self.chunks.chunks(cut.nodes):
            projected = self.rasteriser.project(chunk, camera)
            visible = projected.records[:, Record.CUT] > 0
            records.append(projected.records[visible])
            if projected.keys is not None:
                keys.append(projected.keys[visible])
        # Chunks have no keys if they are sorted by distance.
        shown = Projected(torch.cat(records), torch.cat(keys) if len(keys) == len(records) else None)
        return camera, shown, cut.error

    def _report(self, cut: Cut) -> None:
        """Report a level error that the memory limit has made larger than before."""
        if cut.error >= NEWS * self._reported and cut.error > self.settings.level_error:
            limit = f"{self.settings.memory_limit:g} MB"
            say(f"--memory-limit {limit}: a picture has a level error of {cut.error:.3g} pixels; more memory lowers it")
            self._reported = cut.error

    def _read(self, index: int) -> Gaussians:
        return self.file.read(index).map(lambda values: values.to(self.device))
