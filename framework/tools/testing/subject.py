"""A method under test: how checks build, train and show it."""

from __future__ import annotations

import sys
import traceback
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from statistics import fmean
from typing import Any

import torch
from torch import Tensor

from framework.base.config import RayConfig, TrainConfig
from framework.base.device import seed_step
from framework.cameras.view import every
from framework.data.dataset import Dataset
from framework.data.pixels import PixelBatch, background_colors, composite, gather_batch
from framework.data.sources import Request, make_source
from framework.geometry.rays import Rays
from framework.method import Method
from framework.model import LearnsMotion, Loss, Model
from framework.ray_model import RayModel
from framework.rendering.rendered import Picture, Rendered
from framework.tools.testing.finding import Fault
from framework.tools.testing.scenes import ball_in_a_box, ball_under_a_sky, moving_ball
from framework.training.optim import Adam, make_optimizer, set_learning_rate
from framework.training.step import backward, forward

RAYS = 256
"""In a step, at most."""
STEPS = 60
"""Of the training that several checks look at."""
BUDGET = 200
"""Steps that schedules take the run to have; checks train for the first of them."""
SEED = 42
STRIDE = 3
"""Of an image's rows and columns, one in so many is shown when a picture is judged."""
SHOWN_EVERY = 9
"""Of all pixels, one in so many is shown when rays are judged."""


class Learner:
    """A model that takes the trainer's steps on one scene.

    Args:
        method: what is trained.
        config: its settings.
        dataset: the scene's images.
        seed: of the model's first parameters.
    """

    def __init__(self, method: Method, config: TrainConfig, dataset: Dataset, seed: int) -> None:
        torch.manual_seed(seed)
        self.config, _ = method.decide(config, dataset.scene)
        self.dataset = dataset
        self.model: Model[Any] = method.build(self.config, dataset.scene)
        self.source = make_source(self.model.batches, dataset, self.config)
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

    def batch(self, rays_per_pixel: int = 1) -> Any:
        """Return what the next step learns from.

        Args:
            rays_per_pixel: rays through each pixel, where it is pixels.
        """
        seed_step(SEED, self.done)
        count = min(self.config.num_rays_per_batch, RAYS) if isinstance(self.config, RayConfig) else 0
        return self.source.draw(Request(self.done, count, rays_per_pixel))

    def rendered(self, rays: Rays, background: Tensor) -> Rendered:
        """Return what rays show as the next step sees it; of a model that casts rays.

        Args:
            rays: R rays.
            background: (R, 3) or (3,).
        """
        self.model.train()
        self.model.before_step(self.done, self.done / BUDGET)
        return self.rays_model.render(rays, background)

    @property
    def rays_model(self) -> RayModel[Any]:
        """The model, which casts rays."""
        assert isinstance(self.model, RayModel)
        return self.model

    def loss(self, batch: Any, bfloat16: bool = False) -> Loss:
        """Return what the method makes of a batch in the next step.

        Args:
            batch: what is learnt from.
            bfloat16: run networks in bfloat16.
        """
        return forward(self.model, batch, self.done, self.done / BUDGET, bfloat16)

    def step(self) -> None:
        """Take one step of training."""
        self.step_backward()
        self.descend()

    def step_backward(self) -> None:
        """Take the first half of a step: its gradients."""
        self.backward(self.loss(self.batch()))

    def backward(self, loss: Loss) -> None:
        """Leave the gradients of a loss where the optimiser finds them.

        Args:
            loss: of a batch.
        """
        total = loss.total
        self.has_gradient = total.requires_grad
        backward(total, self.optimizer)
        self.history.append(float(total.detach()))

    def descend(self) -> None:
        """Take the second half: the optimiser's step, where there are gradients, and what the model does then."""
        set_learning_rate(self.optimizer, self.config, self.done, self.done / BUDGET)
        if self.has_gradient:
            self.optimizer.step()
        for change in self.model.after_step(self.done, self.done / BUDGET):
            self.optimizer.change_rows(change)
        self.done += 1

    # -- looking ----------------------------------------------------------------------------------------------

    def view(self) -> PixelBatch:
        """Return some pixels of every image, over white."""
        flat = torch.arange(0, len(self.dataset.pixels), SHOWN_EVERY)
        return gather_batch(self.dataset, flat, background_colors("white", len(flat), flat.device))

    @torch.no_grad()
    def show(self, rays: Rays, background: Tensor, seed: int = SEED) -> Rendered:
        """Return what rays show as the evaluator sees it: of no training camera, whatever was drawn before.

        Args:
            rays: R rays.
            background: (R, 3) or (3,).
            seed: of torch's generator.
        """
        self.model.eval()
        seed_step(seed, 0)
        return self.rays_model.render(replace(rays, camera_indices=None), background)

    def picture(self, index: int = 0, background: float = 1.0, seed: int = SEED) -> Picture:
        """Return the picture of a view as the evaluator sees it.

        Args:
            index: which image's view.
            background: all channels of the colour behind it.
            seed: of torch's generator.
        """
        seed_step(seed, 0)
        return self.model.render_view(self.dataset.view(index, STRIDE), torch.full((3,), background))

    def error(self) -> float:
        """Return the mean squared error of some pixels of every image, over white."""
        errors = []
        for index in range(len(self.dataset)):
            rgba = every(self.dataset.image(index), STRIDE).float() / 255
            errors.append(float((self.picture(index).rgb - composite(rgba, torch.ones(3))).square().mean()))
        return fmean(errors)


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
        if issubclass(self.method.model, LearnsMotion):
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
        file = getattr(sys.modules.get(type(self.method.config).__module__), "__file__", None)
        lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == file]
        return f"{said} ({Path(str(file)).name}, line {lines[-1]})" if lines else said
