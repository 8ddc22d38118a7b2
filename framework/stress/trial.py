"""A short run under a condition: training, evaluation, and a check for finite results.

It runs in this process, so a crash, for example in a compiled kernel, ends the process.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from statistics import fmean
from typing import Any

import torch
from torch import Tensor

from nerfloom.base.config import TrainConfig
from nerfloom.base.device import choose_device
from nerfloom.base.errors import NerfloomError
from nerfloom.base.plain import from_plain
from nerfloom.base.signals import Stopped
from nerfloom.data.dataset import Dataset
from nerfloom.data.pixels.batch import composite
from nerfloom.data.scene import Scene
from nerfloom.data.sources import BatchSource, Request
from nerfloom.evaluation.evaluator import evaluate
from nerfloom.evaluation.metrics import psnr
from nerfloom.kernels.adam.adam import all_finite
from nerfloom.method import Method
from nerfloom.model import Model
from nerfloom.registry import load_method
from nerfloom.renderable import with_refined_poses
from nerfloom.stress.conditions import Condition
from nerfloom.stress.scenes import Views
from nerfloom.training.run import Run
from nerfloom.training.trainer import Trainer

MAX_RAYS, MAX_SAMPLES = 512, 2**14
"""Maximum number of rays and of samples per step, so that a large network does hundreds of steps in a minute."""
NEVER = 10**9
"""Steps or seconds between checkpoints, more than in any run."""


@dataclass(frozen=True)
class Budget:
    """Length of a run, in steps and seconds, whichever is reached first."""

    steps: int
    """Maximum number of training steps."""
    seconds: float | None
    """Maximum seconds of training; None for no limit."""


@dataclass(frozen=True)
class Trial:
    """Result of a run."""

    psnr: float | None = None
    """PSNR of the test views, dB; None if it is not finite."""
    steps: int = 0
    """Number of training steps done."""
    skipped: int = 0
    """Number of steps dropped because they were not finite."""
    seconds: float = 0.0
    """Seconds of training."""
    error: str | None = None
    """Message of the error, or about the non-finite value, on one line; None without either."""
    refused: bool = False
    """Whether the error is one for users (NerfloomError)."""
    learnt: float | None = None
    """PSNR minus the PSNR of images of the background alone, dB; None if there is no PSNR."""


class StressedSource(BatchSource):
    """A `source` of batches that a `condition` changes: the number of rays per step, or the batches."""

    def __init__(self, source: BatchSource, condition: Condition) -> None:
        self.source, self.condition, self.dataset = source, condition, source.dataset
        self.contradicted = source.contradicted

    def draw(self, request: Request) -> Any:
        if self.condition.rays is not None:
            request = replace(request, num_pixels=max(self.condition.rays // request.rays_per_pixel, 1))
        batch = self.source.draw(request)
        return batch if self.condition.spoil is None else self.condition.spoil(batch, request.step)

    def drawing_from(self, dataset: Dataset) -> StressedSource:
        return StressedSource(self.source.drawing_from(dataset), self.condition)

    def learn(self, request: Request, batch: Any, rgb: Tensor) -> None:
        self.source.learn(request, batch, rgb)


def attempt(condition: Condition, run: Run, views: Views, budget: Budget) -> Trial:
    """Train and evaluate a run under a condition; errors become part of the result.

    Args:
        run: the method and its settings; its folder is not used.
        views: the plain images.
        budget: length of the run.

    Raises:
        Stopped: if a signal stops the run.
    """
    try:
        return _trained_and_evaluated(condition, run, views, budget)
    except (Exception, SystemExit) as error:
        return Trial(error=in_a_line(error), refused=isinstance(error, NerfloomError))


def _trained_and_evaluated(condition: Condition, run: Run, views: Views, budget: Budget) -> Trial:
    method = load_method(run.method)
    config = shortened(run.config, budget, method, views.train.scene)
    config = from_plain(config, condition.settings(config), condition.name)
    changed = condition.change(views).to(choose_device(config.machine))
    trainer = Trainer(method, config, changed.train)
    trainer.source = StressedSource(trainer.source, condition)  # the settings are decided now, --robust too
    if (number := trainer.train().stopped_by) is not None:
        raise Stopped(number)
    state = trainer.state
    test = with_refined_poses(trainer.model, changed.test)
    test_psnr = float(evaluate(trainer.model, test).results["psnr"])
    trial = Trial(steps=state.step, skipped=state.skipped, seconds=state.seconds, error=unsound(trainer, test))
    if not math.isfinite(test_psnr):
        return replace(trial, error=trial.error or "the PSNR of the test views is not finite")
    return replace(trial, psnr=test_psnr, learnt=test_psnr - blank_psnr(trainer.model, test))


def shortened(config: TrainConfig, budget: Budget, method: Method, scene: Scene) -> TrainConfig:
    """Return the settings of a short run, with small steps and no files but the last checkpoint.

    Args:
        budget: length of the run.
        method: the method; it fills in the number of samples per step and the learning rate if they are open.
        scene: properties of the plain images.
    """
    config = replace(
        config,
        max_num_iterations=budget.steps,
        max_seconds=budget.seconds,
        target_psnr=None,
        vis="none",
        seconds_per_save=float(NEVER),
        steps_per_save=NEVER,
    )
    decided = method.decided(config, scene)[0]
    config = replace(config, learning_rate=decided.learning_rate)
    if method.model.batches != "pixels":
        return config
    rays, samples = min(decided.num_rays_per_batch, MAX_RAYS), decided.samples_per_batch
    sizes = {"num_rays_per_batch": rays, "samples_per_batch": None if samples is None else min(samples, MAX_SAMPLES)}
    return replace(config, **sizes)


def blank_psnr(model: Model[Any], test: Dataset) -> float:
    """Return the mean PSNR, dB, of `test` images that show only the background of `model`, masked pixels included."""
    background = model.background
    images = (composite(test.image(index).float() / 255, background) for index in range(len(test)))
    return fmean(psnr(background.expand_as(image), image) for image in images)


def unsound(trainer: Trainer, test: Dataset) -> str | None:
    """Return which parameter, running error or value of the first `test` view of a `trainer` is not finite, or None.

    The PSNR alone would hide an infinite colour, because it is computed on colours clamped to [0, 1].
    """
    for name, parameter in trainer.model.named_parameters():
        if not all_finite([parameter]):
            return f"the parameter {name} is not finite"
    if not math.isfinite(trainer.state.train_mse):
        return "the running mean of the training error is not finite"
    picture = trainer.model.render_view(test.view(0), trainer.model.background)
    for name, values in (("colour", picture.rgb), ("depth", picture.depth), ("opacity", picture.accumulation)):
        if not bool(torch.isfinite(values).all()):
            return f"the {name} of a test view is not finite"
    return None


def in_a_line(error: BaseException) -> str:
    """Return the message of an `error` on one line, with its type unless it is a NerfloomError."""
    words = " ".join(str(error).split())
    return words if isinstance(error, NerfloomError) else f"{type(error).__name__}: {words}"
