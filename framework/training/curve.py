"""A run's learning curve: how well it shows held-out images as training goes.

Evaluations over all held-out images are rare and as many as the user asked for. Between them a few images, evenly
chosen and always the same, are looked at on a schedule by time, so that every run has a curve. Where whole images would
take too long, every n-th row and column of their pixels stands for them: the same rays as of a whole image, so PSNR
estimates that of the whole image without bias. SSIM is of the picture that those pixels make.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import asdict, astuple, dataclass
from statistics import fmean
from typing import Any, TypeAlias

from framework.data.dataset import Dataset
from framework.evaluation.evaluator import Measured, evaluation_background, measure_view, spread, views_to_judge
from framework.model import Model
from framework.training.progress import StepReport

FEW = 3
"""Images that are looked at between evaluations over all."""
SHARE = 0.05
"""Looking at them takes at most this share of the seconds of training."""
MARGIN = 0.8
"""Part of that share that is planned with; what a look will take is known from the one before only."""
SPACING = 1.15
"""A look comes at the earliest after so many times the seconds of training of the one before."""
NUM_LOOKS = 10
"""Pixels are left out where a run would not have time for so many looks."""
PICTURE_SPEED = 2.0
"""Before the first look, a ray of a picture is taken to be so many times as fast as one of training, which also learns
from it. Measured: 2 to 7 times."""
MOST_PIXELS = 2**14
"""Most pixels of an image that are looked at; more would tell little more."""
LEAST_SIDE = 16
"""Pixels along the shorter side of an image that are looked at, at least: SSIM needs 11."""

Entry: TypeAlias = (
    "tuple[float, int, float] | tuple[float, int, float, float | None, int | None, int, float | None, bool]"
)
"""A point as a checkpoint holds it, one of early versions having three values only."""


@dataclass(frozen=True)
class Point:
    """An evaluation during training."""

    seconds: float
    """Seconds of training until then."""
    step: int
    psnr: float
    """Mean over images, dB."""
    ssim: float | None = None
    """Mean over images; None where they are too small, or where an early version wrote the point."""
    images: int | None = None
    """How many; None where an early version wrote the point."""
    pixel_stride: int = 1
    """Every so many-th row and column of their pixels."""
    evaluation_seconds: float | None = None
    """Seconds the evaluation took; they are not part of `seconds`."""
    full: bool = True
    """Whether it is over all held-out images, or the --max-eval-images of them that were asked for."""

    def entry(self) -> Entry:
        """For a checkpoint, which holds plain data."""
        return astuple(self)


def in_order(*curves: Sequence[Entry]) -> list[Point]:
    """All points in order of their steps."""
    points = [Point(*entry) for entries in curves for entry in entries]
    return sorted(points, key=lambda point: (point.step, point.full))


def rows(points: Sequence[Point]) -> list[dict[str, Any]]:
    """For learning_curve.json; a PSNR that is not finite, which JSON cannot hold, is null."""
    return [{**asdict(point), "psnr": point.psnr if math.isfinite(point.psnr) else None} for point in points]


def num_rays(sizes: Sequence[tuple[int, int]], stride: int, rays_per_pixel: int) -> int:
    """Rays of every `stride`-th row and column of images of (height, width) `sizes`."""
    return rays_per_pixel * sum(math.ceil(height / stride) * math.ceil(width / stride) for height, width in sizes)


def pixel_stride(sizes: Sequence[tuple[int, int]], rays_per_pixel: int, rays: float) -> int:
    """Smallest stride at which images of (height, width) `sizes` take about `rays` rays together at most.

    None takes more than MOST_PIXELS pixels, and none becomes smaller than LEAST_SIDE by it.
    """
    largest = max(min(map(min, sizes)) // LEAST_SIDE, 1)
    most = max(height * width for height, width in sizes)
    allowed = min(rays / rays_per_pixel / len(sizes), MOST_PIXELS)
    return min(math.ceil(math.sqrt(most / allowed)), largest) if allowed > 0 else largest


def is_due(points: Sequence[Point], seconds: float, cost: float, *, last: bool = False) -> bool:
    """Whether a few images are looked at now.

    Args:
        points: looks so far.
        seconds: of training so far.
        cost: seconds that a look will take.
        last: whether training ends here, so that there is no later one.
    """
    spent = sum(point.evaluation_seconds or 0.0 for point in points)
    if spent + cost > MARGIN * SHARE * seconds:
        return False
    return last or not points or seconds >= SPACING * points[-1].seconds


class FewImages:
    """The few held-out images of a run, and when they are looked at.

    Args:
        dataset: held-out images.
        limit: look at no more than this many; None for no limit, 0 for none.
        rays_per_pixel: of pictures.
    """

    def __init__(self, dataset: Dataset, limit: int | None, rays_per_pixel: int) -> None:
        shown = views_to_judge(dataset)
        self._dataset, self._rays_per_pixel = dataset, rays_per_pixel
        self._views = [shown[place] for place in spread(len(shown), FEW if limit is None else min(limit, FEW))]
        cameras = dataset.cameras
        self._sizes = [(int(cameras.heights[view]), int(cameras.widths[view])) for view in self._views]

    def look_if_due(self, model: Model, looks: Sequence[Entry], report: StepReport, *, last: bool) -> Point | None:
        """Look at the images if it is time to.

        Args:
            looks: earlier ones.
            report: the training step that was just done.
            last: whether training ends with it.
        """
        if not self._views or (looks and not last and report.seconds < SPACING * looks[-1][0]):
            return None
        points = [Point(*entry) for entry in looks]
        stride, cost = self._plan(points, report)
        if not is_due(points, report.seconds, cost, last=last):
            return None
        start = time.perf_counter()
        found = self._measure(model, stride)
        took = time.perf_counter() - start
        return Point(report.seconds, report.step, found.psnr, found.ssim, len(self._views), stride, took, full=False)

    def _plan(self, points: Sequence[Point], report: StepReport) -> tuple[int, float]:
        """The stride of the next look, and how many seconds it will take.

        The first look is of as few pixels as may be, for it shows how long a ray takes; the second chooses the stride
        by what the whole run has time for, and all later ones keep it.
        """
        if not points:
            stride = pixel_stride(self._sizes, self._rays_per_pixel, 0)
            rate = PICTURE_SPEED * report.rays_per_second
            return stride, num_rays(self._sizes, stride, self._rays_per_pixel) / rate
        before, took = points[-1].pixel_stride, points[-1].evaluation_seconds or 0.0
        if len(points) > 1:
            return before, took
        rate = num_rays(self._sizes, before, self._rays_per_pixel) / max(took, 1e-6)
        allowed = MARGIN * SHARE * report.seconds / report.progress / NUM_LOOKS
        stride = pixel_stride(self._sizes, self._rays_per_pixel, rate * allowed)
        return stride, num_rays(self._sizes, stride, self._rays_per_pixel) / rate

    def _measure(self, model: Model, stride: int) -> Measured:
        """Mean PSNR and SSIM of every `stride`-th row and column.

        Photographs are shown in the mean appearance, whatever --eval-appearance says: finding one for each takes long.
        """
        background = evaluation_background(model)
        found = [measure_view(model, self._dataset, view, background, stride) for view in self._views]
        ssims = [one.ssim for one in found if one.ssim is not None]
        return Measured(fmean(one.psnr for one in found), fmean(ssims) if len(ssims) == len(found) else None)
