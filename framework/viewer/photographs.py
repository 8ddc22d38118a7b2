"""The training images in the viewer: cameras, thumbnails, and errors against them."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from nerfloom.base.console import say
from nerfloom.base.errors import NerfloomError
from nerfloom.base.evenly_spaced import strided
from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.ndc import Ndc, NdcCameras
from nerfloom.cameras.view import View
from nerfloom.data.image_files import Content, read_image
from nerfloom.data.parsed_scene import ParsedScene
from nerfloom.data.pixels.batch import composite
from nerfloom.renderable import Renderable, refined_cameras
from nerfloom.training.run import Run
from nerfloom.viewer.request import Pose

MAX_SHOWN = 200
"""Maximum number of cameras shown."""
THUMBNAIL = 96
"""Longer side of a thumbnail, pixels."""
MAX_SHIFT, MAX_ANGLE = 1e-3, 0.02
"""Maximum distance, relative to the spread of the cameras, and angle in radians between a view and its photograph."""


class Photographs:
    """Training images of a run. Nothing is read before it is needed, and no file twice at a time.

    Args:
        run: the run, with the folder and the format of its data; None for none.
        model: function that returns the model shown now; the cameras are in its scene.
    """

    def __init__(self, run: Run | None, model: Callable[[], Renderable]) -> None:
        self._run, self._model = run, model
        self._lock = threading.RLock()
        self._whole = lru_cache(maxsize=1)(self._read)
        self._small = lru_cache(maxsize=4 * MAX_SHOWN)(self._thumbnail)

    @property
    def parsed(self) -> ParsedScene | None:
        """The training split, not decoded; None if it cannot be read, which is reported once."""
        with self._lock:
            return self._parsed

    @cached_property
    def _parsed(self) -> ParsedScene | None:
        try:
            return None if self._run is None else self._run.parse("train")
        except (NerfloomError, OSError) as error:
            say(f"the photographs are not shown: {error}")
            return None

    @cached_property
    def _given(self) -> Cameras | None:
        """Cameras as the data say, for the sizes of the decoded images; None if there are none."""
        parsed = self.parsed
        return None if parsed is None else parsed.cameras.scaled(1 / parsed.downscale_factor)

    @property
    def cameras(self) -> Cameras | None:
        """Cameras in the scene, for the sizes of the decoded images; None if there are none."""
        return None if self._given is None else refined_cameras(self._model(), self._given, training=True)

    @property
    def ndc(self) -> Ndc | None:
        """Normalised device coordinates of the scene; None if it has none."""
        return self._given.ndc if isinstance(self._given, NdcCameras) else None

    def chosen(self) -> list[int]:
        """Return the indices of the images with cameras shown, at most `MAX_SHOWN`, evenly spaced."""
        return [] if self._given is None else strided(len(self._given), MAX_SHOWN)

    def name(self, index: int) -> str:
        """Return the file name of image `index`."""
        return "" if self.parsed is None else self.parsed.image_paths[index].name

    def pose(self, index: int) -> Tensor:
        """Return the pose (3, 4) of image `index`, camera-to-scene."""
        cameras = self.cameras
        assert cameras is not None
        return cameras.camera_to_worlds[index]

    def fov(self, index: int) -> float:
        """Return the vertical field of view of image `index`, radians; 60 degrees for lenses other than pinhole."""
        cameras = self._given
        assert cameras is not None
        if cameras.model not in ("pinhole", "opencv"):
            return math.radians(60)
        return 2 * math.atan(0.5 * float(cameras.heights[index]) / float(cameras.fy[index]))

    def time(self, index: int) -> float | None:
        """Return the time of image `index` in [0, 1]; None in a static scene."""
        times = None if self.parsed is None else self.parsed.times
        return None if times is None else float(times[index])

    def thumbnail(self, index: int) -> np.ndarray | None:
        """Return a thumbnail (H, W, 3) uint8 of image `index`, over white; None if the file cannot be read."""
        with self._lock:
            return self._small(index)

    def _thumbnail(self, index: int) -> np.ndarray | None:
        assert self.parsed is not None
        return small_picture(self.parsed.image_paths[index])

    def _read(self, index: int) -> Tensor | None:
        assert self.parsed is not None
        try:
            return torch.from_numpy(read_image(self.parsed.image_paths[index], self.parsed.downscale_factor).copy())
        except (NerfloomError, OSError) as error:
            say(f"the error is not shown: {error}")
            return None

    # -- errors -----------------------------------------------------------------------------------------------

    def at(self, pose: Pose, time: float | None = None) -> int | None:
        """Return the image with a camera at `pose`, and of several the one at `time`; None without one."""
        cameras = self.cameras
        if cameras is None or self.ndc is not None:
            return None
        known, here = cameras.camera_to_worlds.double(), pose.tensor()
        distances = (known[:, :, 3] - here[:, 3]).norm(dim=-1)
        size = float((known[:, :, 3] - known[:, :, 3].mean(0)).norm(dim=-1).max()) or 1.0
        ahead = (known[:, :, 2] * here[:, 2]).sum(-1)
        close = (distances <= MAX_SHIFT * size) & (ahead >= math.cos(MAX_ANGLE))
        if not bool(close.any()):
            return None
        times = None if self.parsed is None else self.parsed.times
        order = distances if times is None or time is None else (times.double() - time).abs()
        return int(torch.where(close, order, torch.inf).argmin())

    def truth(self, view: View, rgb: Tensor, background: Tensor) -> Tensor | None:
        """Return the photograph's colours in the pixels of a view from the photograph's position.

        Seen from one position, a direction has the same colour in every picture, at all distances. So the view's
        pixels are projected into the photograph, through its lens. Pixels outside it keep the rendered colour.

        Args:
            view: a view from a photograph's position.
            rgb: (H, W, 3) rendered colours of the view in [0, 1].
            background: (3,) colour behind transparent pixels.

        Returns:
            (H, W, 3) colours; None if there is no photograph from that position.
        """
        matrix = view.camera.camera_to_worlds[0].double().cpu().flatten().tolist()
        with self._lock:
            index = self.at(Pose(tuple(matrix), 1.0), view.time)
            image, cameras = None if index is None else self._whole(index), self.cameras
        if index is None or image is None or cameras is None:
            return None
        rays = view.camera.pixel_rays(view.pixels().reshape(-1), 0.0, 1.0)
        columns, rows, seen = cameras.project(rays.origins.cpu() + rays.directions.cpu(), index)
        height, width = image.shape[:2]
        seen &= (columns > -0.5) & (rows > -0.5) & (columns < width - 0.5) & (rows < height - 0.5)
        flat = composite(image.float() / 255, background.cpu()).permute(2, 0, 1)[None]
        places = torch.stack([(columns + 0.5) / width, (rows + 0.5) / height], -1) * 2 - 1
        options: dict[str, Any] = {"align_corners": False, "padding_mode": "border"}
        found = torch.nn.functional.grid_sample(flat, places[None, None], **options)[0, :, 0].T
        return torch.where(seen[:, None].to(rgb.device), found.to(rgb), rgb.reshape(-1, 3)).view(rgb.shape)


def small_picture(path: Path) -> np.ndarray | None:
    """Return the image `path` reduced to `THUMBNAIL` pixels over white, (H, W, 3) uint8; None if it cannot be read.

    A JPEG is decoded at an eighth of its size if that suffices.
    """
    try:
        with Image.open(Content(path)) as image:
            image.draft("RGB", (THUMBNAIL, THUMBNAIL))
            image.thumbnail((THUMBNAIL, THUMBNAIL))
            rgba = image.convert("RGBA")
        paper = Image.new("RGBA", rgba.size, (255, 255, 255, 255))
        return np.asarray(Image.alpha_composite(paper, rgba).convert("RGB"))
    except Exception:  # any type, as in `read_image`
        return None
