"""Where batches come from: pixels in memory, pixels in a file, or whole images."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from framework.base.config import RayConfig, TrainConfig
from framework.cameras.cameras import CENTER, subpixels
from framework.cameras.view import View
from framework.data.dataset import Dataset
from framework.data.error_map import ErrorMap
from framework.data.pixel_stream import PixelStream
from framework.data.pixels import (
    Background,
    LookUp,
    PixelBatch,
    ViewBatch,
    background_colors,
    composite,
    draw_batch,
    training_background,
)


@dataclass(frozen=True)
class Request:
    """What a training step asks for."""

    step: int
    """Training steps done."""
    num_pixels: int
    """Pixels to draw; of no meaning where batches are whole images."""
    rays_per_pixel: int = 1
    """Rays through each pixel: 1 for its centre, else a square number."""


class BatchSource(ABC):
    """Draws what a training step learns from.

    A batch is a function of torch's generator, which is seeded by (seed, step) before each step, and of what the source
    has learnt; so a run that goes on in another process draws the same.
    """

    dataset: Dataset
    """The images that are drawn from."""

    @abstractmethod
    def draw(self, request: Request) -> Any:
        """Return a `PixelBatch` or a `ViewBatch`.

        Args:
            request: what the step asks for.
        """

    @abstractmethod
    def drawing_from(self, dataset: Dataset) -> BatchSource:
        """Return a source of the same kind, and with what this one has learnt, of a changed data set.

        Args:
            dataset: the same images, of which other pixels may be worth drawing.
        """

    def learn(self, batch: Any, squared_errors: Tensor) -> None:  # noqa: B027, most have nothing to learn
        """Take note of how wrong a batch was shown.

        Args:
            batch: what was drawn.
            squared_errors: the mean over channels of each pixel's squared error, shaped as the batch's pixels.
        """

    def state(self) -> Tensor | None:
        """Return what has been learnt, for a checkpoint; None for nothing."""
        return None

    def restore(self, state: Tensor | None) -> None:  # noqa: B027, likewise
        """Go on with what a checkpoint holds.

        Args:
            state: from `state`; None where the checkpoint has none.
        """


class PixelSource(BatchSource):
    """Pixels of all images, drawn evenly or by where the error was large.

    Args:
        dataset: the images; where they lie in a file, pixels are read ahead of the steps that draw them.
        background: behind transparent pixels.
        seed: the run's.
        by_error: draw half of the pixels where the error was large lately.
    """

    def __init__(self, dataset: Dataset, background: Background, seed: int, by_error: bool = False) -> None:
        self.dataset, self.background, self.seed = dataset, background, seed
        self.errors = ErrorMap(dataset) if by_error else None
        self.stream: PixelStream | None = None

    def draw(self, request: Request) -> PixelBatch:
        offsets = CENTER if request.rays_per_pixel == 1 else subpixels(request.rays_per_pixel)
        look_up = self._look_up(request.step)
        return draw_batch(self.dataset, request.num_pixels, self.background, self.errors, offsets, look_up)

    def _look_up(self, step: int) -> LookUp | None:
        """Return what finds a step's colours, if they lie in a file."""
        if self.dataset.mapped is None:
            return None
        self.stream = self.stream or PixelStream(self.dataset, self.seed)
        return partial(self.stream.look_up, step)

    def drawing_from(self, dataset: Dataset) -> PixelSource:
        source = PixelSource(dataset, self.background, self.seed)
        source.errors = self.errors
        return source

    def learn(self, batch: PixelBatch, squared_errors: Tensor) -> None:
        if self.errors is not None:
            self.errors.learn(batch.pixels, squared_errors)

    def state(self) -> Tensor | None:
        return None if self.errors is None else self.errors.errors

    def restore(self, state: Tensor | None) -> None:
        if self.errors is not None and state is not None:
            self.errors.errors.copy_(state)


class ViewSource(BatchSource):
    """Whole images, one a step, each as likely as the others.

    Args:
        dataset: the images.
        background: behind transparent pixels: of "random", one colour for the whole image.
    """

    def __init__(self, dataset: Dataset, background: Background) -> None:
        self.dataset, self.background = dataset, background

    def draw(self, request: Request) -> ViewBatch:
        dataset = self.dataset
        index = int(torch.randint(len(dataset), ()))
        behind = background_colors(self.background, 1, dataset.device)[0]
        rgba = dataset.image(index).float() / 255
        alpha = rgba[..., 3] if rgba.shape[-1] == 4 else None
        view = View.of(dataset.cameras, index, dataset.times)
        return ViewBatch(index, view, composite(rgba, behind), behind, alpha)

    def drawing_from(self, dataset: Dataset) -> ViewSource:
        return ViewSource(dataset, self.background)


def make_source(kind: str, dataset: Dataset, config: TrainConfig) -> BatchSource:
    """Return the source that a model learns from.

    Args:
        kind: the model's `batches`.
        dataset: images to learn from, on the device.
        config: the run's settings.
    """
    background = training_background(config.background, dataset.scene.has_alpha)
    if kind == "views":
        return ViewSource(dataset, background)
    by_error = isinstance(config, RayConfig) and config.draw_by_error
    return PixelSource(dataset, background, config.machine.seed, by_error)
