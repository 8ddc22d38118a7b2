"""Sources of training batches: pixels in memory, pixels in a file, or whole images."""

from __future__ import annotations

from abc import ABC, abstractmethod
from copy import copy
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from nerfloom.base.config import TrainConfig
from nerfloom.base.processes import processes
from nerfloom.cameras.cameras import subpixels
from nerfloom.cameras.view import View
from nerfloom.data.dataset import Dataset
from nerfloom.data.free_space import clear_distances
from nerfloom.data.pixels.batch import (
    Background,
    LookUp,
    PixelBatch,
    ViewBatch,
    background_colors,
    draw_batch,
    known_distances,
    training_background,
    view_colors,
)
from nerfloom.data.pixels.contradicted import STEPS_PER_LOOK, ContradictedTiles, ContradictedViews
from nerfloom.data.pixels.left_out import LeftOutTiles
from nerfloom.data.pixels.stream import PixelStream
from nerfloom.data.sparse_depth import SparseDepth


@dataclass(frozen=True)
class Request:
    """A training step's request for a batch."""

    step: int
    """Number of training steps done."""
    num_pixels: int
    """Number of pixels to draw; not used if batches are whole images."""
    rays_per_pixel: int = 1
    """Number of rays through each pixel: 1, through its centre, or another square number."""
    points: bool = True
    """Whether to draw some additional pixels with a sparse depth, if the source learns from them."""
    progress: float = 0.0
    """Fraction of the budget spent, 0 to 1."""


KEYPOINTS = 1 / 8
"""Fraction of a batch that is drawn from the pixels with a sparse depth."""
POINTS_UNTIL = 0.5
"""Duration of this drawing, as a fraction of the budget; afterwards colours alone determine the surfaces."""
SCOUTED_ALONG = 24
"""Number of tiles along an image's longer side with `--robust scout`, which compares images with a finished field."""


class BatchSource(ABC):
    """Base class of sources, which draw training batches.

    A batch depends only on what the source has learnt and on torch's generator, which is seeded by (seed, step, process
    number) before each step. So a run resumed in another process draws the same batches.
    """

    dataset: Dataset
    """The images to draw from."""
    varies: str | None = "batches are made on the host"
    """Why drawing a batch differs from step to step (`StepKind`); None if it does not."""
    contradicted: LeftOutTiles | None = None
    """Tiles that do not count, with `--robust`."""

    @abstractmethod
    def draw(self, request: Request) -> Any:
        """Return a `PixelBatch` or a `ViewBatch` for `request`."""

    def drawing_from(self, dataset: Dataset) -> BatchSource:
        """Return a source of the same kind for a changed data set, with this source's learnt state.

        Args:
            dataset: the same images, with a different selection of pixels to draw.
        """
        source = copy(self)
        source.dataset = dataset
        return source

    def learn(self, request: Request, batch: Any, rgb: Tensor) -> None:  # noqa: B027, most have nothing to learn
        """Record the errors of colours `rgb`, rendered for a `batch` that was drawn for `request`."""

    def state(self) -> Tensor | None:
        """Return the learnt state for a checkpoint; None if the source learns nothing."""
        return None if self.contradicted is None else self.contradicted.state

    def restore(self, state: Tensor | None) -> None:
        """Restore the learnt `state` from a checkpoint; None if the checkpoint has none."""
        if self.contradicted is not None and state is not None:
            self.contradicted.state.copy_(state)


class PixelSource(BatchSource):
    """Draws pixels of all images, uniformly.

    Args:
        dataset: the images. Pixels in a file are read ahead of the steps that use them.
        background: background of transparent pixels.
        seed: seed of the run.
        keypoints: fraction of a batch that is drawn from the pixels with a sparse depth, if there are any.
        clear: (M,) distances from cameras that images show to be empty; None if they are not used.
        num_images: number of images that the pixels of a step come from; None for all.
        contradicted: tiles that do not count; None if all do.
        placed: whether rays have their positions in the images (`Rays.places`).
    """

    def __init__(
        self,
        dataset: Dataset,
        background: Background,
        seed: int,
        keypoints: float = 0.0,
        clear: Tensor | None = None,
        num_images: int | None = None,
        contradicted: LeftOutTiles | None = None,
        placed: bool = False,
    ) -> None:
        self.clear, self.num_images, self.contradicted, self.placed = clear, num_images, contradicted, placed
        self.dataset, self.background, self.seed = dataset, background, seed
        self.keypoints = keypoints if dataset.sparse_depth is not None else 0.0
        self.stream: PixelStream | None = None
        self.varies = "pixels of a few images are drawn" if num_images is not None else None
        if not dataset.resident:
            self.varies = "the images are not on the device"

    def draw(self, request: Request) -> PixelBatch:
        offsets = subpixels(request.rays_per_pixel, self.dataset.device)
        look_up, count = self._look_up(request.step), request.num_pixels
        keypoints = round(self.keypoints * count) if request.points else 0
        batch = draw_batch(self.dataset, count, self.background, offsets, look_up, keypoints, self.num_images)
        if self.contradicted is not None:
            counting = self.contradicted.counting(batch.pixels)
            weights = counting if batch.weights is None else counting * batch.weights
            distances = None if batch.distances is None else counting * batch.distances  # 0 is unknown
            batch = replace(batch, weights=weights, distances=distances)
        if self.placed:
            places = self.dataset.cameras.places(batch.pixels, offsets)
            batch = replace(batch, rays=replace(batch.rays, places=places))
        if self.clear is None or batch.rays.camera_indices is None:
            return batch
        return replace(batch, clear=self.clear[batch.rays.camera_indices[:: batch.rays_per_pixel]])

    def _look_up(self, step: int) -> LookUp | None:
        """Return the function that looks up a step's colours read ahead from a file; None if none are."""
        if self.dataset.mapped is None or self.num_images is not None:
            return None
        self.stream = self.stream or PixelStream(self.dataset, self.seed)
        return partial(self.stream.look_up, step)

    def drawing_from(self, dataset: Dataset) -> PixelSource:
        source = copy(self)
        source.dataset, source.stream = dataset, None
        return source

    def learn(self, request: Request, batch: PixelBatch, rgb: Tensor) -> None:
        if self.contradicted is not None:
            self.contradicted.learn(batch.pixels, rgb - batch.rgb)
            if request.step % STEPS_PER_LOOK == 0:
                self.contradicted.decide(request.progress)


class ViewSource(BatchSource):
    """Draws whole images, one per step, in a new random order for each pass.

    Several processes take turns in this order.

    Args:
        background: background of transparent pixels; "random" is one colour for the whole image.
        seed: the seed of the run.
        contradicted: tiles that do not count; None if all do.
    """

    def __init__(
        self, dataset: Dataset, background: Background, seed: int, contradicted: LeftOutTiles | None = None
    ) -> None:
        self.dataset, self.background, self.seed, self.contradicted = dataset, background, seed, contradicted
        self._order: tuple[int, list[int]] | None = None
        self._views: dict[int, View] = {}
        """Views of images drawn so far; sizes and lenses are read from the device once."""
        self._sparse_ends: list[int] | None = None
        """Start of each image's sparse depths, and the end of the last image's."""

    def draw(self, request: Request) -> ViewBatch:
        dataset = self.dataset
        index = self._index(request.step)
        behind = background_colors(self.background, 1, dataset.device)[0]
        rgb, alpha = view_colors(dataset.image(index), behind)
        if index not in self._views:
            self._views[index] = View.of(dataset.cameras, index, dataset.times)
        view, weights, distances = self._views[index], self._masked(index), self._distances(index)
        if self.contradicted is not None:
            counting = self.contradicted.weights(index, request.progress)
            weights = counting if weights is None else weights if counting is None else counting * weights
        if weights is not None and distances is not None:
            distances = torch.where(weights == 1, distances, 0)  # 0 is unknown
        return ViewBatch(index, view, rgb, behind, alpha, weights, distances)

    def learn(self, request: Request, batch: ViewBatch, rgb: Tensor) -> None:
        if self.contradicted is not None and batch.index is not None:
            errors, masked = rgb - batch.rgb, self._masked(batch.index)
            errors = errors if masked is None else errors * masked[..., None]
            self.contradicted.learn_view(batch.index, errors, batch.rgb, request.progress)

    def _masked(self, index: int) -> Tensor | None:
        """Return 1 for the pixels (H, W) of an image that masks keep, and 0 for others; None without masks."""
        dataset = self.dataset
        if dataset.kept is None:
            return None
        first, last = dataset.cameras.ends[index : index + 2]
        return dataset.kept.mask(first, last).view(dataset.cameras.sizes[index]).float()

    def _distances(self, index: int) -> Tensor | None:
        dataset = self.dataset
        if dataset.depths is None:
            return None if dataset.sparse_depth is None else self._sparse_distances(index, dataset.sparse_depth)
        pixels = dataset.cameras.image_pixels(index)
        rays = dataset.cameras.pixel_rays(pixels, dataset.scene.near, dataset.scene.far, dataset.times)
        found = known_distances(dataset, pixels, rays)
        return None if found is None else found.view(dataset.cameras.sizes[index][0], -1)

    def _sparse_distances(self, index: int, known: SparseDepth) -> Tensor:
        cameras = self.dataset.cameras
        if self._sparse_ends is None:
            self._sparse_ends = torch.searchsorted(known.pixels, cameras.offsets.to(known.pixels)).tolist()
        (first, last), here = cameras.ends[index : index + 2], slice(*self._sparse_ends[index : index + 2])
        distances = known.distances.new_zeros(last - first)
        distances[known.pixels[here] - first] = known.distances[here]
        return distances.view(cameras.sizes[index][0], -1)

    def _index(self, step: int) -> int:
        """Return the image of a training step; it depends only on seed, step and process."""
        several = processes()
        epoch, place = divmod(step * several.count + several.rank, len(self.dataset))
        if self._order is None or self._order[0] != epoch:
            generator = torch.Generator().manual_seed((self.seed * 1_000_003 + epoch) % 2**63)
            self._order = epoch, torch.randperm(len(self.dataset), generator=generator).tolist()
        return self._order[1][place]


def make_source(kind: str, dataset: Dataset, config: TrainConfig) -> BatchSource:
    """Return the source of training batches of a `kind` (`Model.batches`) from `dataset`, by `config`."""
    background = training_background(config.background, dataset.scene)
    contradicted = _contradicted(kind, dataset, config)
    if kind == "views":
        return ViewSource(dataset, background, config.machine.seed, contradicted)
    num_images = config.images_per_batch or None
    keypoints = KEYPOINTS if num_images is None and config.depth_loss_mult and not dataset.scene.has_depth else 0.0
    clear = None
    if config.free_space_loss_mult > 0 and not dataset.scene.warped:
        clear = clear_distances(dataset.cameras, dataset.sparse_depth, dataset.scene.near, dataset.scene.far)
    placed = config.appearance == "grid"
    return PixelSource(dataset, background, config.machine.seed, keypoints, clear, num_images, contradicted, placed)


def _contradicted(kind: str, dataset: Dataset, config: TrainConfig) -> LeftOutTiles | None:
    """Return the tiles of `--robust`; None if it is off."""
    if config.robust == "scout":
        return LeftOutTiles(dataset, SCOUTED_ALONG)
    if config.robust == "errors":
        return ContradictedViews(dataset) if kind == "views" else ContradictedTiles(dataset)
    return None
