"""Times of the viewer: first picture, pictures of a moving camera, finished picture.

There is no browser and no socket: times are measured from a request to the JPEG file.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import numpy as np
from torch import Tensor

from nerfloom.data.scene import Scene
from nerfloom.training.load import load
from nerfloom.training.run_path import trained_run
from nerfloom.viewer.browser import FINE_QUALITY, Browser
from nerfloom.viewer.render_queue import RenderQueue
from nerfloom.viewer.request import Pose, Request

WARM_UP = 12
"""Number of pictures of a moving camera before the measurement."""


@dataclass(frozen=True)
class Times:
    """Seconds of a viewer's pictures of one run or file."""

    run: str
    """Last three names of its path. Of a run: data, method and time."""
    method: str
    """Name of the method."""
    width: int
    """Width of the finished picture, pixels."""
    height: int
    """Height of the finished picture, pixels."""
    first: float
    """Seconds from the first request to the first picture, as a JPEG file."""
    coarse: float
    """Median seconds for pictures of a moving camera."""
    slowest: float
    """Maximum seconds for pictures of a moving camera."""
    stride: int
    """Stride of the last of these pictures, pixels."""
    per_second: float
    """Pictures of a moving camera per second."""
    finished: float
    """Seconds from the last request to the finished picture, including the time that the camera must rest."""
    rays_per_pixel: int
    """Rays per pixel of the finished picture."""


def measured(run: Path, width: int, height: int, count: int = 60, data: Path | None = None) -> Times:
    """Measure pictures in one browser: the camera turns, then rests until the last is done.

    Args:
        run: the run or file, as `nerfloom.load` takes it.
        width, height: size of the browser's picture, pixels.
        count: number of pictures of the moving camera.
        data: folder of the data: of a file, or of a run if it has moved.

    Raises:
        ConfigError, CheckpointError, DataError: if it cannot be loaded, or is a file and its data are not given.
    """
    loaded = load(trained_run(run, None, data), device_type="cpu", data=data)
    scene, start = loaded.model.scene, loaded.parsed("train").cameras.camera_to_worlds[0, :, 3]
    queue = RenderQueue(loaded)
    shown: list[tuple[float, int]] = []

    def show(image: np.ndarray, quality: int) -> None:
        _jpeg(image, quality)
        shown.append((time.perf_counter(), quality))

    browser = Browser(show)
    queue.add(0, browser)
    begun = time.perf_counter()
    queue.ask(0, _always(_request(scene, start, 0, width, height)))
    queue.draw_next()
    first = shown[-1][0] - begun
    seconds = []
    for index in range(WARM_UP + count):
        begun = time.perf_counter()
        queue.ask(0, _always(_request(scene, start, index + 1, width, height)))
        queue.draw_next()
        seconds.append(shown[-1][0] - begun)
    moving = seconds[WARM_UP:]
    while browser.pieces:
        if queue.draw_next() is None:
            threading.Event().wait(0.005)
    assert shown[-1][1] == FINE_QUALITY
    return Times(
        "/".join(loaded.origin.resolve().parts[-3:]),
        loaded.method,
        width,
        height,
        first,
        median(moving),
        max(moving),
        browser.stride or 0,
        len(moving) / sum(moving),
        shown[-1][0] - begun,
        loaded.model.rays_per_pixel,
    )


def _always(request: Request) -> Callable[[Request | None], Request]:
    return lambda _: request


def _jpeg(image: np.ndarray, quality: int) -> bytes:
    import imageio.v3 as iio

    return iio.imwrite("<bytes>", image, extension=".jpeg", quality=quality)


def _request(scene: Scene, start: Tensor, index: int, width: int, height: int) -> Request:
    """Return a request for a camera that circles the scene at the distance of a position `start` (3,)."""
    center = scene.box.mean(0).double()
    radius, angle = float((start.double() - center).norm()), 0.02 * index
    place = (radius * 0.9 * math.cos(angle), radius * 0.9 * math.sin(angle), radius * 0.436)
    back = [value / radius for value in place]
    right = (-math.sin(angle), math.cos(angle), 0.0)
    up = (
        back[1] * right[2] - back[2] * right[1],
        back[2] * right[0] - back[0] * right[2],
        back[0] * right[1] - back[1] * right[0],
    )
    rows = [(right[axis], up[axis], back[axis], float(center[axis]) + place[axis]) for axis in range(3)]
    matrix = tuple(value for row in rows for value in row)
    return Request(Pose(matrix, 0.7), width, height, time=0.5 if scene.moving else None)
