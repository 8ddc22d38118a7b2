"""Evaluations of a run's held-out images during training."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any

from nerfloom.base.config import TrainConfig
from nerfloom.base.console import say
from nerfloom.data.dataset import Dataset
from nerfloom.data.pixels.batch import composite
from nerfloom.evaluation.evaluator import evaluate, timed_view
from nerfloom.evaluation.panels import composed, view_panels
from nerfloom.model import Model
from nerfloom.renderable import with_refined_poses
from nerfloom.training.budget import evaluation_seconds
from nerfloom.training.curve import FewImages, Point, in_order, rows
from nerfloom.training.progress import StepReport, TensorBoard
from nerfloom.training.run import write_report
from nerfloom.training.state import State

PICTURE_SHARE = 0.1
"""Maximum time for TensorBoard's images, as a fraction of the training time."""
SECONDS_TO_A_TARGET = 15.0
"""Default seconds of training between evaluations of all images, with a target PSNR."""


class HeldOut:
    """Evaluations of the held-out `dataset` between steps of `model`. Their time does not count as training.

    `dataset` may hold a few of the images, or be None for no evaluation. The learning curve is written into
    `folder`, unless that is None.
    """

    def __init__(self, config: TrainConfig, model: Model[Any], dataset: Dataset | None, folder: Path | None) -> None:
        self.config, self.model, self._given, self.folder = config, model, dataset, folder
        self.load_all: Callable[[], Dataset | None] | None = None
        """Loads all held-out images on first use; None if `dataset` has them all."""
        limit = config.max_eval_images
        self._few = None if dataset is None else FewImages(dataset, limit, model.rays_per_pixel)
        self._last = self._picture_seconds = 0.0

    @cached_property
    def dataset(self) -> Dataset | None:
        """All held-out images; None for no evaluation."""
        return self._given if self.load_all is None or self._given is None else self.load_all()

    def resume(self, state: State) -> None:
        """Continue after the last evaluation of a restored `state`."""
        self._last = state.curve[-1][0] if state.curve else 0.0

    def evaluate_if_due(self, state: State, board: TensorBoard) -> None:
        """Show one image on `board` or evaluate all of them, if due; the curve of `state` receives the result."""
        config, step = self.config, state.step
        if self._given is None or config.max_eval_images == 0:
            return
        affordable = self._picture_seconds + self._seconds_per_image(state) <= PICTURE_SHARE * state.seconds
        shown = step % config.steps_per_eval_image == 0 and "tensorboard" in config.vis and affordable
        if shown and self.dataset is not None:
            self._show((step // config.steps_per_eval_image - 1) % len(self.dataset), self.dataset, step, board)
        every = config.seconds_per_eval_all_images
        if every is None and config.target_psnr is not None:
            every = SECONDS_TO_A_TARGET
        due = every is not None and state.seconds - self._last >= every
        if (due or step % config.steps_per_eval_all_images == 0) and self.dataset is not None:
            self._last, start = state.seconds, time.perf_counter()
            limit = evaluation_seconds(config, state) if every is None else None
            evaluation = evaluate(
                self.model,
                with_refined_poses(self.model, self.dataset),
                max_images=config.max_eval_images,
                seconds=limit,
                lpips_weights=config.lpips_weights,
            )
            psnr, ssim, images = (evaluation.results[name] for name in ("psnr", "ssim", "num_images"))
            full = images == min(evaluation.results["num_images_in_split"], config.max_eval_images or math.inf)
            cost = time.perf_counter() - start
            state.curve += (Point(state.seconds, step, psnr, ssim, images, 1, cost, full).entry(),)
            board.scalars({"eval/psnr": psnr} | ({} if ssim is None else {"eval/ssim": ssim}), step)
            say(f"{state.seconds:5.0f} s  step {step:,}  {evaluation.line()}")
            self.write_curve(state)

    def _seconds_per_image(self, state: State) -> float:
        """Return the seconds of a whole image, estimated from the last evaluation of a few; infinity without one."""
        if not state.looks:
            return math.inf
        last = Point(*state.looks[-1])
        return (last.evaluation_seconds or 0.0) / (last.images or 1) * last.pixel_stride**2

    def _show(self, index: int, dataset: Dataset, step: int, board: TensorBoard) -> None:
        """Show image `index` beside its render."""
        background = self.model.background
        view = with_refined_poses(self.model, dataset).view(index)
        picture, seconds = timed_view(self.model, view, background)
        target = composite(dataset.image(index).float() / 255, background)
        panels = view_panels(picture.rgb.clamp(0, 1), target, picture)
        self._picture_seconds += seconds
        board.image("eval/comparison", composed(panels), step)

    def look_if_due(self, state: State, report: StepReport, board: TensorBoard, *, last: bool) -> None:
        """Evaluate a few images if due after `report`, the `last` one or not, into `state` and on `board`."""
        if self._few is None:
            return
        point = self._few.look_if_due(self.model, state.looks, report, last=last)
        if point is not None:
            state.looks += (point.entry(),)
            values = {"eval_few_images/psnr": point.psnr, "eval_few_images/ssim": point.ssim}
            board.scalars({name: value for name, value in values.items() if value is not None}, point.step)
            self.write_curve(state)

    def write_curve(self, state: State) -> None:
        """Write all evaluations of a `state` to learning_curve.json, if there is a folder."""
        if self.folder is not None:
            write_report(self.folder / "learning_curve.json", rows(in_order(state.curve, state.looks)))
