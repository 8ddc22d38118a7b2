"""Learning curves: PSNR and SSIM of held-out images over the training time.

Evaluations of all held-out images are rare, and the user sets their schedule. Between them a few images, evenly spaced
and always the same, are evaluated on a time schedule, so that every run has a curve. If whole images would take too
long, only every n-th row and column of pixels is rendered, with the same rays as in the whole image. Their PSNR is an
unbiased estimate of the whole image's. SSIM is computed on the image of these pixels.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import asdict, astuple, dataclass
from statistics import fmean
from typing import Any, TypeAlias

from nerfloom.base.device import runs_ahead
from nerfloom.base.evenly_spaced import strided
from nerfloom.base.json_files import finite_or_null
from nerfloom.data.dataset import Dataset
from nerfloom.evaluation.evaluator import Measured, measure_view, views_to_judge
from nerfloom.renderable import Renderable, with_refined_poses
from nerfloom.training.progress import StepReport

MAX_IMAGES = 3
"""Maximum number of images that are evaluated between evaluations of all images."""
MAX_TIME_SHARE = 0.05
"""Maximum time of these evaluations, as a fraction of the seconds of training."""
PLANNED_SHARE = 0.8
"""Fraction of that time to plan with; the next evaluation's time is estimated from the last one's."""
MIN_SPACING = 1.15
"""Minimum ratio of the training times at consecutive evaluations."""
NUM_LOOKS = 10
"""Number of evaluations per run that the pixel stride is chosen for."""
PICTURE_SPEED = 2.0
"""Ratio of rays per second in rendering and in training, assumed before the first evaluation. Measured: 2 to 7."""
MAX_PIXELS = 2**14
"""Maximum number of evaluated pixels per image; more would add little precision."""
MIN_SIDE = 16
"""Minimum number of evaluated pixels along the shorter side of an image; SSIM needs 11."""

Entry: TypeAlias = (
    tuple[float, int, float] | tuple[float, int, float, float | None, int | None, int, float | None, bool]
)  # not quoted: Python 3.10 does not resolve strings within tuple[...], and checkpoints are checked against this type
"""A point in a checkpoint; points of early versions have only the first three values."""


@dataclass(frozen=True)
class Point:
    """An evaluation during training."""

    seconds: float
    """Seconds of training so far."""
    step: int
    """Number of training steps done."""
    psnr: float
    """Mean PSNR of the images, dB."""
    ssim: float | None = None
    """Mean SSIM of the images; None if they are too small, or in points of early versions."""
    images: int | None = None
    """Number of images; None in points of early versions."""
    pixel_stride: int = 1
    """Distance between evaluated rows and columns, pixels."""
    evaluation_seconds: float | None = None
    """Seconds of the evaluation, which are not part of `seconds`."""
    full: bool = True
    """Whether all held-out images were evaluated, or --max-eval-images of them."""

    def entry(self) -> Entry:
        """Return the point as plain data, for a checkpoint."""
        return astuple(self)


def in_order(*curves: Sequence[Entry]) -> list[Point]:
    """Return the points of all `curves` in order of their steps."""
    points = [Point(*entry) for entries in curves for entry in entries]
    return sorted(points, key=lambda point: (point.step, point.full))


def rows(points: Sequence[Point]) -> list[dict[str, Any]]:
    """Return `points` as the rows of learning_curve.json; a metric that is not finite is None, as JSON lacks NaN."""
    return [finite_or_null(asdict(point)) for point in points]


def num_rays(sizes: Sequence[tuple[int, int]], stride: int, rays_per_pixel: int) -> int:
    """Return the rays in every `stride`-th row and column of images of `sizes` (height, width), `rays_per_pixel` each.

    The sum is over all images.
    """
    return rays_per_pixel * sum(math.ceil(height / stride) * math.ceil(width / stride) for height, width in sizes)


def pixel_stride(sizes: Sequence[tuple[int, int]], rays_per_pixel: int, rays: float) -> int:
    """Return the smallest stride for at most about a given number of rays in all images together.

    No image then has more than MAX_PIXELS pixels, and no shorter side less than MIN_SIDE pixels.

    Args:
        sizes: (height, width) of each image, pixels.
        rays_per_pixel: rays per rendered pixel.
        rays: maximum number of rays of all images together.
    """
    largest = max(min(map(min, sizes)) // MIN_SIDE, 1)
    most = max(height * width for height, width in sizes)
    allowed = min(rays / rays_per_pixel / len(sizes), MAX_PIXELS)
    return min(math.ceil(math.sqrt(most / allowed)), largest) if allowed > 0 else largest


def is_due(points: Sequence[Point], seconds: float, cost: float, *, last: bool = False) -> bool:
    """Return whether to evaluate a few images, at a `cost` in seconds, after `seconds` of training with `points`.

    `last` tells that training ends here.
    """
    spent = sum(point.evaluation_seconds or 0.0 for point in points)
    if spent + cost > PLANNED_SHARE * MAX_TIME_SHARE * seconds:
        return False
    return last or not points or seconds >= MIN_SPACING * points[-1].seconds


class FewImages:
    """The few images of a held-out `dataset`, `limit` at most, that are evaluated between evaluations of all images.

    Each rendered pixel has `rays_per_pixel` rays. Without a `limit`, there are `MAX_IMAGES`.
    """

    def __init__(self, dataset: Dataset, limit: int | None, rays_per_pixel: int) -> None:
        views = views_to_judge(dataset)
        self._dataset, self._rays_per_pixel = dataset, rays_per_pixel
        few = MAX_IMAGES if limit is None else min(limit, MAX_IMAGES)
        self._views = [views[index] for index in strided(len(views), few)]
        cameras = dataset.cameras
        self._sizes = [(int(cameras.heights[view]), int(cameras.widths[view])) for view in self._views]

    def look_if_due(self, model: Renderable, looks: Sequence[Entry], report: StepReport, *, last: bool) -> Point | None:
        """Evaluate the images if an evaluation is due.

        Args:
            model: the model.
            looks: earlier evaluations of these images.
            report: report of the last training step.
            last: whether training ends with that step.

        Returns:
            The evaluation; None if none is due.
        """
        if not self._views or (looks and not last and report.seconds < MIN_SPACING * looks[-1][0]):
            return None
        points = [Point(*entry) for entry in looks]
        stride, cost = self._plan(points, report)
        if not is_due(points, report.seconds, cost, last=last):
            return None
        if not points and runs_ahead(model.device):
            self._measure(model, stride)  # compiles kernels, which must not count as this evaluation's time
        start = time.perf_counter()
        found = self._measure(model, stride)
        cost = time.perf_counter() - start
        return Point(report.seconds, report.step, found.psnr, found.ssim, len(self._views), stride, cost, full=False)

    def _plan(self, points: Sequence[Point], report: StepReport) -> tuple[int, float]:
        """Return the pixel stride of the next evaluation and its estimated seconds.

        The first evaluation uses the smallest number of pixels and measures the time per ray. The second chooses the
        stride from the available time, and all later ones keep it.
        """
        if not points:
            stride = pixel_stride(self._sizes, self._rays_per_pixel, 0)
            rate = PICTURE_SPEED * report.rays_per_second
            return stride, num_rays(self._sizes, stride, self._rays_per_pixel) / rate
        stride, cost = points[-1].pixel_stride, points[-1].evaluation_seconds or 0.0
        if len(points) > 1:
            return stride, cost
        rate = num_rays(self._sizes, stride, self._rays_per_pixel) / max(cost, 1e-6)
        allowed = PLANNED_SHARE * MAX_TIME_SHARE * report.seconds / report.progress / NUM_LOOKS
        stride = pixel_stride(self._sizes, self._rays_per_pixel, rate * allowed)
        return stride, num_rays(self._sizes, stride, self._rays_per_pixel) / rate

    def _measure(self, model: Renderable, stride: int) -> Measured:
        """Return the mean PSNR and SSIM of every `stride`-th row and column.

        Rendering uses the mean appearance regardless of --eval-appearance, since fitting one per image is slow.
        """
        background, dataset = model.background, with_refined_poses(model, self._dataset)
        measured = [measure_view(model, dataset, view, background, stride) for view in self._views]
        ssims = [image.ssim for image in measured if image.ssim is not None]
        return Measured(fmean(image.psnr for image in measured), fmean(ssims) if len(ssims) == len(measured) else None)
