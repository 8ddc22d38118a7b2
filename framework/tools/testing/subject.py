"""A method under test: how checks build, train and show it."""

from __future__ import annotations

import sys
import traceback
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from framework.base.config import TrainConfig
from framework.base.device import seed_step
from framework.cameras.cameras import CENTER
from framework.data.dataset import Dataset
from framework.data.pixels import Batch, background_colors, draw_batch, gather_batch, training_background
from framework.geometry.rays import Rays
from framework.model import Method, Model
from framework.rendering.volume import Rendered
from framework.tools.testing.finding import Fault
from framework.tools.testing.scenes import ball_in_a_box, ball_under_a_sky, moving_ball
from framework.training.optim import Adam, make_optimizer, set_learning_rate

RAYS = 256
"""In a step, at most."""
STEPS = 60
"""Of the training that several checks look at."""
BUDGET = 200
"""Steps that schedules take the run to have; checks train for the first of them."""
SEED = 42
SHOWN_EVERY = 9
"""Of the photographs' pixels, one in so many is shown when a picture is judged."""


class Learner:
    """A model that takes the trainer's steps on one scene.

    Args:
        method: what is trained.
        config: its settings.
        dataset: the scene's photographs.
        seed: of the model's first parameters.
    """

    def __init__(self, method: Method, config: TrainConfig, dataset: Dataset, seed: int) -> None:
        torch.manual_seed(seed)
        self.config, self.dataset = config.resolved(), dataset
        self.model: Model[Any] = method.model(self.config, dataset.scene)
        self.done = 0
        """Steps taken."""
        self.history: list[float] = []
        """The loss before each."""
        self.has_gradient = False
        """Whether the last loss leads back to the parameters; it does not where every ray meets nothing."""

    @cached_property
    def optimizer(self) -> Adam:
        """As the trainer makes it."""
        return make_optimizer(self.model, self.config)

    # -- learning ---------------------------------------------------------------------------------------------

    def batch(self, places: Tensor = CENTER) -> Batch:
        """The pixels of the next step, each seen through `places` (K, 2)."""
        seed_step(SEED, self.done)
        count = min(self.config.num_rays_per_batch, RAYS)
        background = training_background(self.config.background, self.dataset.scene.has_alpha)
        return draw_batch(self.dataset, count, background, subpixels=places)

    def rendered(self, rays: Rays, background: Tensor) -> Rendered:
        """The picture of rays as the next step sees it."""
        self.model.train()
        self.model.before_step(self.done, self.done / BUDGET)
        return self.model.render(rays, background)

    def losses(self, batch: Batch) -> tuple[Rendered, dict[str, Tensor]]:
        """The picture of a batch's pixels as the next step sees it, and what the method says of it."""
        count = len(batch.rays) // len(batch.pixels)
        rendered = self.rendered(batch.rays, batch.background.repeat_interleave(count, 0)).per_pixel(count)
        return rendered, self.model.loss(rendered, batch, self.done)

    def step(self) -> None:
        """One step of training."""
        self.step_backward()
        self.descend()

    def step_backward(self) -> None:
        """The first half of a step: its gradients."""
        self.backward(self.losses(self.batch())[1])

    def backward(self, losses: dict[str, Tensor]) -> None:
        """Leave the gradients of the losses' sum where the optimiser finds them."""
        loss = total(losses)
        self.optimizer.zero_grad()
        self.has_gradient = loss.requires_grad
        if self.has_gradient:
            loss.backward()
        self.history.append(float(loss.detach()))

    def descend(self) -> None:
        """The second half: the optimiser's step, where there are gradients."""
        set_learning_rate(self.optimizer, self.config, self.done, self.done / BUDGET)
        if self.has_gradient:
            self.optimizer.step()
        self.done += 1

    # -- looking ----------------------------------------------------------------------------------------------

    def view(self) -> Batch:
        """Some pixels of every photograph, over white."""
        flat = torch.arange(0, len(self.dataset.pixels), SHOWN_EVERY)
        return gather_batch(self.dataset, flat, background_colors("white", len(flat), flat.device))

    @torch.no_grad()
    def show(self, rays: Rays, background: Tensor, seed: int = SEED) -> Rendered:
        """The picture of rays as the evaluator sees it: of no training camera, whatever was drawn before."""
        self.model.eval()
        seed_step(seed, 0)
        return self.model.render(replace(rays, camera_indices=None), background)

    def error(self) -> float:
        """Mean squared error of the pixels of `view`."""
        view = self.view()
        return float((self.show(view.rays, view.background).rgb - view.rgb).square().mean())


def total(losses: dict[str, Tensor]) -> Tensor:
    """What is minimised."""
    return torch.stack(list(losses.values())).sum()


class Subject:
    """The method under test.

    Args:
        method: what is tested.
        name: what messages call it.
        config: its settings; its own if None.
    """

    def __init__(self, method: Method, name: str, config: TrainConfig | None) -> None:
        self.method, self.name = method, name
        self.config = method.config if config is None else config

    @cached_property
    def still(self) -> Dataset:
        """A still scene in a box, whose photographs have alpha."""
        return ball_in_a_box()

    @cached_property
    def scenes(self) -> dict[str, Dataset]:
        """All that the method has to cope with, by what messages call it."""
        scenes = {"a still scene in a box": self.still, "photographs without alpha or box": ball_under_a_sky()}
        if self.method.model.learns_motion:
            scenes["a scene that moves"] = moving_ball()
        return scenes

    def learner(self, dataset: Dataset | None = None, seed: int = SEED) -> Learner:
        """A fresh model on a scene; on the still one if None."""
        return Learner(self.method, self.config, dataset or self.still, seed)

    @cached_property
    def trained(self) -> Learner:
        """A model after STEPS steps on the still scene."""
        learner = self.learner()
        for _ in range(STEPS):
            learner.step()
        return learner

    def on_each_scene(self, look: Callable[[Learner], None]) -> None:
        """Let `look` judge a fresh model on each of `scenes`.

        Raises: Fault that names the scene.
        """
        for where, dataset in self.scenes.items():
            try:
                look(self.learner(dataset))
            except Exception as error:
                raise Fault(f"on {where}: {self.described(error)}") from error

    def described(self, error: Exception) -> str:
        """An error in one line, with the last line of the method's own file that led to it."""
        if isinstance(error, Fault):
            return str(error)
        said = " ".join(f"{type(error).__name__}: {error}".split())[:300]
        file = getattr(sys.modules.get(self.method.model.__module__), "__file__", None)
        lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == file]
        return f"{said} ({Path(str(file)).name}, line {lines[-1]})" if lines else said
