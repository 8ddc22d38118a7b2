"""Batches of a teacher's views, in turns with batches of photographs.

A teacher renders views between and around the training cameras, so that its rays lie within the space that these can
see. A batch of its views has no image: light, exposure and poses that images have of their own are not learnt from it.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from nerfloom.base.config import TrainConfig
from nerfloom.base.console import track
from nerfloom.base.device import stream_seed
from nerfloom.base.errors import ConfigError
from nerfloom.cameras.cameras import Cameras, subpixels
from nerfloom.cameras.unseen import unseen_poses
from nerfloom.cameras.view import View
from nerfloom.data.dataset import Dataset
from nerfloom.data.pixels.batch import Background, PixelBatch, ViewBatch, background_colors, training_background
from nerfloom.data.sources import BatchSource, Request, make_source
from nerfloom.model import Model
from nerfloom.renderable import RendersFromImages
from nerfloom.rendering.rendered import Picture
from nerfloom.training.distillation import TakesTeacher
from nerfloom.training.teacher import Teacher, load_teacher

VIEWS = 4
"""Number of views that the pixels of a batch come from."""
PICTURES = 48
"""Number of pictures that a teacher renders, each when it is first drawn."""
MIN_PICTURES, MAX_PICTURES = 6, 4 * PICTURES
"""Minimum and maximum number of pictures that are rendered ahead."""
MAX_SIDE = 800
"""Maximum longer side of an image in pixels; views of larger images are reduced."""
OPAQUE = 0.95
"""Minimum opacity of a pixel for its distance to count."""
GOLDEN = (5**0.5 - 1) / 2
"""Fractional part of the golden ratio; its multiples are spread most evenly."""
PICTURE_STREAM = -3
"""Random stream of a picture, beside the streams of steps (`nerfloom.base.device`)."""
Render = Callable[[View, Tensor], Picture]
"""Function from a view and the colour (3,) of a background to a picture, as `Renderable.render_view`."""


def is_taught(step: int, share: float) -> bool:
    """Return whether a step belongs to the teacher.

    The steps are spread evenly by the fractional parts of multiples of the golden ratio (Weyl 1916). So are its steps
    among every second step, every fourth, and so on: work that a method does at such steps only learns from both. No
    memory is needed, so a resumed run goes on with the same steps.

    Args:
        step: number of training steps done.
        share: share of the steps that belong to the teacher.
    """
    return step * GOLDEN % 1 < share


def unseen_cameras(cameras: Cameras, near: Tensor) -> Cameras:
    """Return random cameras between and around the cameras `near` (V,), with lenses and sizes of `cameras`."""
    poses = unseen_poses(cameras.camera_to_worlds.cpu(), near)
    return replace(cameras[near], camera_to_worlds=poses.to(cameras.camera_to_worlds))


def random_part(camera: Cameras, side: int) -> tuple[Cameras, tuple[slice, slice]]:
    """Return the camera of a random part of an image, of the image's shape, and the part's rows and columns.

    Args:
        camera: one camera.
        side: maximum longer side of the part, pixels.
    """
    sizes = camera.sizes[0]
    share = min(side / max(sizes), 1.0)
    height, width = (max(round(share * size), 1) for size in sizes)
    top, left = (int(torch.randint(size - shown + 1, ())) for size, shown in zip(sizes, (height, width), strict=True))
    widths, heights = torch.full_like(camera.widths, width), torch.full_like(camera.heights, height)
    part = replace(camera, cx=camera.cx - left, cy=camera.cy - top, widths=widths, heights=heights)
    return part, (slice(top, top + height), slice(left, left + width))


def known_depths(picture: Picture) -> Tensor:
    """Return the distances (H, W) along the rays of a picture, 0 where it is not opaque."""
    return torch.where(picture.accumulation > OPAQUE, picture.median_depth, 0.0)


class TaughtPixels(BatchSource):
    """Draws pixels of views that `teacher` renders, near the cameras of `dataset`, over a `background`."""

    def __init__(self, teacher: Teacher, dataset: Dataset, background: Background) -> None:
        self.teacher, self.dataset, self.background = teacher, dataset, background

    def draw(self, request: Request) -> PixelBatch:
        dataset, device, count = self.dataset, self.dataset.device, max(request.num_pixels // VIEWS, 1)
        near = torch.randint(len(dataset), (min(VIEWS, request.num_pixels),))
        cameras, times = unseen_cameras(dataset.cameras, near), None if dataset.times is None else dataset.times[near]
        behind = background_colors(self.background, len(near), device)
        numbers, shown = list[Tensor](), list[tuple[Tensor, ...]]()
        for index in range(len(near)):
            pixels, values = self._pixels(View.of(cameras, index, times), count, request.rays_per_pixel, behind[index])
            numbers.append(pixels)
            shown.append(values)
        rgb, opacity, distances = (torch.cat(parts) for parts in zip(*shown, strict=True))
        each = torch.tensor([len(pixels) for pixels in numbers], device=device)
        own = torch.cat([first + pixels for first, pixels in zip(cameras.ends, numbers, strict=False)])
        rays = cameras.pixel_rays(
            own, dataset.scene.near, dataset.scene.far, times, subpixels(request.rays_per_pixel, device)
        )
        return PixelBatch(
            torch.cat([dataset.cameras.ends[n] + pixels for n, pixels in zip(near.tolist(), numbers, strict=True)]),
            replace(rays, camera_indices=None),
            rgb,
            behind.repeat_interleave(each, 0),
            opacity if dataset.scene.has_alpha else None,
            distances,
        )

    def _pixels(self, view: View, count: int, per_pixel: Any, behind: Tensor) -> tuple[Tensor, tuple[Tensor, ...]]:
        """Return the numbers (P,) of at most `count` pixels of a view, and colours, opacities and distances of each."""
        height, width = view.camera.sizes[0]
        stride = max(math.isqrt(height * width // count), 1)
        view = replace(view, stride=stride, rays_per_pixel=per_pixel)
        picture = self.teacher.picture(view, behind)
        numbers = view.pixels().reshape(-1)
        chosen = torch.randperm(len(numbers))[:count].to(numbers.device)
        values = picture.rgb.reshape(-1, 3), picture.accumulation.reshape(-1), known_depths(picture).reshape(-1)
        return numbers[chosen], tuple(each[chosen] for each in values)


class TaughtViews(BatchSource):
    """Draws pictures of a teacher, from a fixed number of views.

    A field on a CPU takes longer for a picture than Gaussians for a step, so each view is rendered once.

    Args:
        render: function that renders the teacher's pictures of views in the scene of `dataset`.
        dataset: the training images; their cameras bound the visible space.
        background: background of transparent pixels, one colour for the whole picture.
        seed: seed of the run.
        unseen_every: every Nth picture is from an unseen pose, and the others are from a training camera.
    """

    def __init__(
        self, render: Render, dataset: Dataset, background: Background, seed: int, unseen_every: int = 1
    ) -> None:
        self.render, self.dataset, self.background, self.seed = render, dataset, background, seed
        self.unseen_every = unseen_every
        sizes = torch.maximum(dataset.cameras.widths, dataset.cameras.heights)
        factor = min(1.0, MAX_SIDE / int(sizes.max()))
        self.cameras = dataset.cameras if factor == 1 else dataset.cameras.scaled(factor)
        self.count, self.side = PICTURES, MAX_SIDE
        """Number of pictures to draw from, and maximum longer side of a new one; it may show a part of an image."""
        generator = torch.Generator().manual_seed(stream_seed(seed, -1, PICTURE_STREAM))
        self.order = torch.randperm(len(dataset), generator=generator)
        """Cameras that views are near: each once before any twice, so that few views are everywhere."""
        self._pictures: dict[int, tuple[View, Tensor, Tensor, Tensor]] = {}

    def render_ahead(self, seconds: float) -> None:
        """Render pictures for about `seconds`, and draw from these alone.

        They are random parts of images, since small images have too little detail. MIN_PICTURES have half of an image's
        width and height; by the time that pixels take, the others are as large as lets PICTURES fit.
        """
        start, pixels = time.perf_counter(), 0
        height, width = self.cameras.sizes[0]
        self.count, self.side = 0, round(max(height, width) / 2)
        for percent in track(range(1, 101), "Rendering pictures", total=100):
            end = start + seconds * percent / 100
            while self.count < MIN_PICTURES or (self.count < MAX_PICTURES and time.perf_counter() < end):
                pixels += self._picture(self.count)[1][..., 0].numel()
                self.count += 1
                if self.count >= MIN_PICTURES:
                    spent = time.perf_counter() - start
                    room = (seconds - spent) / max(PICTURES - self.count, 1) * pixels / spent
                    share = math.sqrt(max(room, 0.0) / (height * width))
                    self.side = round(max(height, width) * min(max(share, 0.5), 1.0))

    def draw(self, request: Request) -> ViewBatch:
        number = int(torch.randint(self.count, ()))
        behind = background_colors(self.background, 1, self.dataset.device)[0]
        view, light, opacity, distances = self._picture(number)
        rgb = light.float() + (1 - opacity.float()[..., None]) * behind
        alpha = opacity.float() if self.dataset.scene.has_alpha else None
        return ViewBatch(None, view, rgb, behind, alpha, distances=distances)

    def _picture(self, number: int) -> tuple[View, Tensor, Tensor, Tensor]:
        """Return a view, its light (H, W, 3) and opacity (H, W), float16, and distances (H, W), 0 where unknown.

        It is rendered at the first call, and depends only on the seed, its `number` and `side`.
        """
        if number not in self._pictures:
            times = self.dataset.times
            with torch.random.fork_rng(devices=[]):  # whether it is new must not change what is drawn after it
                torch.default_generator.manual_seed(stream_seed(self.seed, number, PICTURE_STREAM))
                near = self.order[[number % len(self.order)]]
                is_unseen = (number + 1) % self.unseen_every == 0
                cameras = unseen_cameras(self.cameras, near) if is_unseen else self.cameras[near]
                camera, _ = random_part(cameras, self.side)
                view = View.of(camera, 0, None if times is None else times[near])
                shown = self.render(view, torch.zeros(3, device=self.dataset.device))
            light, opacity = shown.rgb.clamp(0, 1).half(), shown.accumulation.clamp(0, 1).half()
            self._pictures[number] = view, light, opacity, known_depths(shown)
        return self._pictures[number]


class MixedSource(BatchSource):
    """Draws batches of photographs, and of a teacher in a share of the steps.

    Args:
        photographs: source of the photographs.
        taught: source of the teacher's views.
        share: share of the teacher at the start; it falls linearly.
        until: fraction of the budget, more than 0, until the share is 0; infinity for a share that does not fall.
    """

    varies = "a teacher renders some of the batches"

    def __init__(self, photographs: BatchSource, taught: BatchSource, share: float, until: float) -> None:
        self.photographs, self.taught, self.share, self.until = photographs, taught, share, until
        self.dataset, self.contradicted = photographs.dataset, photographs.contradicted

    def of(self, request: Request) -> BatchSource:
        """Return the source of the batch for `request`."""
        share = self.share * max(1 - request.progress / self.until, 0.0)
        return self.taught if is_taught(request.step, share) else self.photographs

    def draw(self, request: Request) -> Any:
        return self.of(request).draw(request)

    def learn(self, request: Request, batch: Any, rgb: Tensor) -> None:
        self.of(request).learn(request, batch, rgb)

    def drawing_from(self, dataset: Dataset) -> MixedSource:
        return MixedSource(
            self.photographs.drawing_from(dataset), self.taught.drawing_from(dataset), self.share, self.until
        )


def batch_source(model: Model[Any], dataset: Dataset, config: TrainConfig) -> BatchSource:
    """Return the source of a model's training batches: photographs, and a teacher's views if there is a teacher.

    A model that asks a teacher itself is given it.

    Args:
        dataset: the training images, on the device.
        config: the settings of the run.

    Raises:
        ConfigError: if the teacher is missing or cannot teach the model.
    """
    photographs = make_source(model.batches, dataset, config)
    if config.teacher is None:
        return photographs
    if isinstance(model, RendersFromImages):
        raise ConfigError("--teacher: a method that renders from photographs has nothing to learn from other pictures")
    teacher = load_teacher(config.teacher, dataset)
    if isinstance(model, TakesTeacher):
        model.take_teacher(teacher)
    if not config.teacher_share * config.teacher_until:
        return photographs
    background = training_background(config.background, dataset.scene)
    taught: BatchSource = TaughtPixels(teacher, dataset, background)
    if model.batches == "views":
        taught = TaughtViews(teacher.picture, dataset, background, config.machine.seed)
    return MixedSource(photographs, taught, config.teacher_share, config.teacher_until)
