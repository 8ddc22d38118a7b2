"""One short run under one condition, in this process: training, evaluation, and whether all is finite at the end.

A crash of the process itself, as in a compiled kernel, cannot be caught here and ends everything.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean
from tempfile import TemporaryDirectory
from typing import Any

import torch
from torch import Tensor

from framework.base.config import RayConfig, TrainConfig, from_plain
from framework.base.device import choose_device
from framework.base.errors import NerfloomError
from framework.base.registry import load_method
from framework.data.dataset import Dataset
from framework.data.pixels import composite
from framework.data.scene import Scene
from framework.data.sources import BatchSource, Request, make_source
from framework.evaluation.evaluator import evaluate, evaluation_background
from framework.evaluation.metrics import psnr
from framework.kernels.adam import all_finite
from framework.method import Method
from framework.model import Model
from framework.tools.stress.conditions import Condition
from framework.tools.stress.scenes import Views
from framework.training.run import Run
from framework.training.signals import Stopped
from framework.training.trainer import Trainer

MOST_RAYS, MOST_SAMPLES = 512, 2**14
"""In a step, so that a large network takes some hundred steps in a minute. Small pictures need no more."""
NEVER = 10**9


@dataclass(frozen=True)
class Budget:
    """How long each run trains: until either is spent."""

    steps: int
    """Steps of training."""
    seconds: float | None
    """Seconds of training; without limit if None."""


@dataclass(frozen=True)
class Trial:
    """What one run showed."""

    psnr: float | None = None
    """Of the test views, dB; None where there is no finite one."""
    steps: int = 0
    """Steps done."""
    skipped: int = 0
    """Of these, dropped because they were not finite."""
    seconds: float = 0.0
    """Of training."""
    error: str | None = None
    """Why nothing came of it that can be used, in a line."""
    refused: bool = False
    """Whether it was the framework that said so, in words for a user (NerfloomError)."""
    learnt: float | None = None
    """dB above pictures that show the background alone, which a run has for nothing; None where there is no PSNR."""


class StressedSource(BatchSource):
    """Batches as a condition wants them.

    Args:
        source: draws them.
        condition: how many rays a step has, and what is wrong with its pixels.
    """

    def __init__(self, source: BatchSource, condition: Condition) -> None:
        self.source, self.condition, self.dataset = source, condition, source.dataset

    def draw(self, request: Request) -> Any:
        if self.condition.rays is not None:
            request = replace(request, num_pixels=max(self.condition.rays // request.rays_per_pixel, 1))
        batch = self.source.draw(request)
        return batch if self.condition.spoil is None else self.condition.spoil(batch, request.step)

    def drawing_from(self, dataset: Dataset) -> StressedSource:
        return StressedSource(self.source.drawing_from(dataset), self.condition)

    def learn(self, batch: Any, squared_errors: Tensor) -> None:
        self.source.learn(batch, squared_errors)


def attempt(condition: Condition, run: Run, views: Views, budget: Budget) -> Trial:
    """Train and judge a run under a condition. Whatever goes wrong is told in the result.

    Args:
        run: the method and its settings; its folder is not used.
        views: the plain photographs.
    Raises: Stopped where somebody stops it.
    """
    with TemporaryDirectory() as folder:
        try:
            return _trained_and_judged(condition, replace(run, folder=Path(folder)), views, budget)
        except (Exception, SystemExit) as error:
            line = in_a_line(error).replace(folder, "the run's folder")
            return Trial(error=line, refused=isinstance(error, NerfloomError))


def _trained_and_judged(condition: Condition, run: Run, views: Views, budget: Budget) -> Trial:
    method = load_method(run.method)
    config = shortened(run.config, budget, method, views.train.scene)
    config = from_plain(config, condition.settings(config), condition.name)
    changed = condition.change(views).to(choose_device(config.machine))
    source = StressedSource(make_source(method.model.batches, changed.train, config), condition)
    trainer = Trainer(replace(run, config=config), changed.train, None, source)
    if (number := trainer.train().stopped_by) is not None:
        raise Stopped(number)
    state = trainer.state
    reached = float(evaluate(trainer.model, changed.test).results["psnr"])
    done = Trial(steps=state.step, skipped=state.skipped, seconds=state.seconds, error=unsound(trainer, changed.test))
    if not math.isfinite(reached):
        return replace(done, error=done.error or "the PSNR of the test views is not finite")
    return replace(done, psnr=reached, learnt=reached - blank_psnr(trainer.model, changed.test))


def shortened(config: TrainConfig, budget: Budget, method: Method, scene: Scene) -> TrainConfig:
    """Return the settings of a short run: the budget, small steps, and nothing written but the last checkpoint.

    Args:
        config: the run's settings.
        budget: how long it trains.
        method: decides how many samples a step has, where that is left to it.
        scene: facts about the plain images.
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
    if not isinstance(config, RayConfig):
        return config
    samples = method.decide(config, scene)[0].samples_per_batch
    return replace(
        config,
        num_rays_per_batch=min(config.num_rays_per_batch, MOST_RAYS),
        samples_per_batch=None if samples is None else min(samples, MOST_SAMPLES),
    )


def blank_psnr(model: Model[Any], test: Dataset) -> float:
    """PSNR of pictures that show the background alone, dB, a mean over views; what masks ignore counts too."""
    background = evaluation_background(model)
    shown = (composite(test.image(index).float() / 255, background) for index in range(len(test)))
    return fmean(psnr(background.expand_as(photograph), photograph) for photograph in shown)


def unsound(trainer: Trainer, test: Dataset) -> str | None:
    """What is not finite in a trained model, its running error, or its picture of the first test view; None if all is.

    Looked for by value: a PSNR alone would not tell an infinite colour, for pictures are cut to [0, 1] first.
    """
    for name, parameter in trainer.model.named_parameters():
        if not all_finite(parameter):
            return f"the parameter {name} is not finite"
    if not math.isfinite(trainer.state.train_mse):
        return "the running mean of the training error is not finite"
    picture = trainer.model.render_view(test.view(0), evaluation_background(trainer.model))
    for name, values in (("colour", picture.rgb), ("depth", picture.depth), ("opacity", picture.accumulation)):
        if not bool(torch.isfinite(values).all()):
            return f"the {name} of a test view is not finite"
    return None


def in_a_line(error: BaseException) -> str:
    """An error in a line; of one that was not meant for users, its type too."""
    words = " ".join(str(error).split())
    return words if isinstance(error, NerfloomError) else f"{type(error).__name__}: {words}"
