"""Frames per second of trained runs, and of files, in colour, along the cameras of held-out images."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import torch
from torch import Tensor

from nerfloom.base.console import track
from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.view import View
from nerfloom.kernels import native
from nerfloom.renderable import Renderable
from nerfloom.splats.gaussians import HasGaussians
from nerfloom.training.load import load
from nerfloom.training.run_path import trained_run

WARM_UP = 4
"""Number of pictures before the measurement."""


@dataclass(frozen=True)
class Frames:
    """Rendering times of one run or file at one size."""

    run: str
    """Last three names of its path. Of a run: data, method and time."""
    method: str
    """Name of the method."""
    num_gaussians: int | None
    """Number of Gaussians; None for other methods."""
    width: int
    """Width of the pictures, pixels."""
    height: int
    """Height of the first picture, pixels."""
    threads: int
    """Number of CPU threads."""
    pictures: int
    """Number of pictures."""
    per_second: float
    """Pictures per second: their number over the sum of their seconds."""
    median: float
    """Median of the seconds of a picture."""
    slowest: float
    """Longest time of a picture, seconds."""
    kernels: dict[str, float]
    """Mean seconds per picture in each compiled kernel, by name."""


@torch.no_grad()
def measure(
    run: Path, widths: tuple[int, ...], threads: tuple[int, ...], count: int, data: Path | None = None
) -> list[Frames]:
    """Render pictures on the CPU and measure the time of each.

    Args:
        run: the run or file, as `nerfloom.load` takes it.
        widths: widths of the pictures, pixels; heights follow from the cameras.
        threads: numbers of CPU threads.
        count: number of pictures at each size, one held-out camera after another.
        data: folder of the data: of a file, or of a run if it has moved.

    Raises:
        ConfigError, CheckpointError, DataError: if it cannot be loaded, or is a file and its data are not given.
    """
    loaded = load(trained_run(run, None, data), device_type="cpu", data=data)
    model, cameras = loaded.model, loaded.parsed("test").cameras
    gaussians = len(model.gaussians()) if isinstance(model, HasGaussians) else None
    background, name = model.background, "/".join(loaded.origin.resolve().parts[-3:])
    rows = []
    for width in widths:
        sized = [_resized(cameras, index % len(cameras), width) for index in range(count)]
        for number in threads:
            with _threads(number):
                seconds, kernels = _seconds(model, sized, background)
            rows.append(
                Frames(
                    name, loaded.method, gaussians, width, sized[0].sizes[0][0], number, count,
                    count / sum(seconds), median(seconds), max(seconds), kernels,
                )
            )  # fmt: skip
    return rows


def _resized(cameras: Cameras, index: int, width: int) -> Cameras:
    camera = cameras[index : index + 1]
    return camera.scaled(width / camera.sizes[0][1])


def _seconds(model: Renderable, cameras: list[Cameras], background: Tensor) -> tuple[list[float], dict[str, float]]:
    """Return the seconds of each picture, and the mean seconds of a picture in each kernel."""
    moment = 0.5 if model.scene.moving else None
    for camera in cameras[:WARM_UP]:
        model.render_rgb(View(camera, moment), background)
    seconds = []
    native.spent = {}
    try:
        for camera in track(cameras, f"{cameras[0].sizes[0][1]} pixels wide", total=len(cameras)):
            begun = time.perf_counter()
            model.render_rgb(View(camera, moment), background)
            seconds.append(time.perf_counter() - begun)
        return seconds, {name: spent / len(cameras) for name, spent in native.spent.items()}
    finally:
        native.spent = None


@contextmanager
def _threads(number: int) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(number)
    try:
        yield
    finally:
        torch.set_num_threads(before)
