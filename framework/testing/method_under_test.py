"""The method under test, with functions to build, train and render it."""

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

from nerfloom.base.config import TrainConfig
from nerfloom.base.device import seed_step
from nerfloom.cameras.view import every
from nerfloom.data.dataset import Dataset
from nerfloom.data.pixels.batch import PixelBatch, background_colors, composite, gather_batch
from nerfloom.data.sources import Request, make_source
from nerfloom.geometry.rays import Rays
from nerfloom.method import Method
from nerfloom.model import LearnsMotion, Loss, Model
from nerfloom.ray_model import RayModel
from nerfloom.rendering.rendered import Picture, Rendered
from nerfloom.testing.finding import Fault
from nerfloom.testing.scenes import ball_in_a_box, ball_under_a_sky, moving_ball
from nerfloom.training.optim import Adam, make_optimizer, set_learning_rate
from nerfloom.training.preparation import show_images
from nerfloom.training.step import backward, forward

MAX_PIXELS = 256
"""Maximum number of pixels in a step."""
STEPS = 60
"""Number of training steps of the model shared by several checks."""
BUDGET = 200
"""Length of the schedules, steps; checks run the first of them."""
SEED = 42
STRIDE = 3
"""Distance between the rendered rows and columns of an image."""
SHOWN_EVERY = 9
"""Distance between rendered pixels, counted over all images, if rays are rendered."""


class Learner:
    """A model in training on `dataset`, with parameters of a `seed` and the trainer's steps."""

    def __init__(self, method: Method, config: TrainConfig, dataset: Dataset, seed: int) -> None:
        torch.manual_seed(seed)
        self.config, _ = method.decided(config, dataset.scene)
        self.dataset = dataset
        self.model: Model[Any] = method.build(self.config, dataset.scene)
        show_images(self.model, dataset, None)
        self.source = make_source(self.model.batches, dataset, self.config)
        self.done = 0
        """Number of training steps done."""
        self.history: list[float] = []
        """Loss before each step."""
        self.has_gradient = False
        """Whether the last loss has a graph; it has none if no ray has samples."""

    @cached_property
    def optimizer(self) -> Adam:
        """The trainer's optimiser of the model."""
        return make_optimizer(self.model, self.config)

    # -- learning ---------------------------------------------------------------------------------------------

    def batch(self, rays_per_pixel: int = 1) -> Any:
        """Return the batch of the next step, with `rays_per_pixel` if it is of pixels."""
        seed_step(SEED, self.done)
        count = min(self.model.config.num_rays_per_batch, MAX_PIXELS) if self.model.batches == "pixels" else 0
        return self.source.draw(Request(self.done, count, rays_per_pixel))

    def rendered(self, rays: Rays, background: Tensor) -> Rendered:
        """Render `rays` over `background`, (R, 3) or (3,), as in the next step; the model must cast rays."""
        self.model.train()
        self.model.before_step(self.done, self.done / BUDGET)
        return self.rays_model.render(rays, background)

    @property
    def rays_model(self) -> RayModel[Any]:
        """The model, which must cast rays."""
        assert isinstance(self.model, RayModel)
        return self.model

    def loss(self, batch: Any, bfloat16: bool = False) -> Loss:
        """Return the loss of `batch`, as the model needs it, in the next step, with networks in `bfloat16` or not."""
        return forward(self.model, batch, self.done, self.done / BUDGET, bfloat16)

    def step(self) -> None:
        """Take one training step."""
        self.step_backward()
        self.descend()

    def step_backward(self) -> None:
        """Take the first half of a training step: compute the gradients."""
        self.backward(self.loss(self.batch()))

    def backward(self, loss: Loss) -> None:
        """Compute the gradients of the `loss` of a batch, for `descend`."""
        total = loss.total
        self.has_gradient = total.requires_grad
        backward(total, self.optimizer)
        self.history.append(float(total.detach()))

    def descend(self) -> None:
        """Take the second half of a training step: update the parameters, if there are gradients."""
        set_learning_rate(self.optimizer, self.config, self.done, self.done / BUDGET)
        if self.has_gradient:
            self.optimizer.step()
        self.model.after_every_step(self.done, self.done / BUDGET, True)
        if self.model.changes_rows(self.done, self.done / BUDGET):
            for change in self.model.after_step(self.done, self.done / BUDGET):
                self.optimizer.change_rows(change)
        self.done += 1

    # -- rendering --------------------------------------------------------------------------------------------

    def view(self) -> PixelBatch:
        """Return every SHOWN_EVERY-th pixel of all images, over white."""
        flat = torch.arange(0, len(self.dataset.pixels), SHOWN_EVERY)
        return gather_batch(self.dataset, flat, background_colors("white", len(flat), flat.device))

    @torch.no_grad()
    def show(self, rays: Rays, background: Tensor, seed: int = SEED) -> Rendered:
        """Render `rays` over `background`, (R, 3) or (3,), as in an evaluation, with a random `seed`."""
        self.model.eval()
        seed_step(seed, 0)
        return self.rays_model.render(replace(rays, camera_indices=None), background)

    def picture(self, index: int = 0, background: float = 1.0, seed: int = SEED) -> Picture:
        """Render every STRIDE-th row and column of view `index` over grey `background`, with a random `seed`."""
        seed_step(seed, 0)
        return self.model.render_view(self.dataset.view(index, STRIDE), torch.full((3,), background))

    def colors(self, index: int = 0, background: float = 1.0, seed: int = SEED) -> Tensor:
        """Render only the colours of the same rows and columns.

        `index`, `background` and `seed` are as in `picture`.
        """
        seed_step(seed, 0)
        return self.model.render_rgb(self.dataset.view(index, STRIDE), torch.full((3,), background))

    def error(self) -> float:
        """Return the mean squared error of every STRIDE-th row and column of all images, over white."""
        errors = []
        for index in range(len(self.dataset)):
            rgba = every(self.dataset.image(index), STRIDE).float() / 255
            errors.append(float((self.picture(index).rgb - composite(rgba, torch.ones(3))).square().mean()))
        return fmean(errors)


class MethodUnderTest:
    """A method under test, called `name` in messages, with `config` or its defaults, and its scenes."""

    def __init__(self, method: Method, name: str, config: TrainConfig | None) -> None:
        self.method, self.name = method, name
        self.config = method.config if config is None else config

    @cached_property
    def still(self) -> Dataset:
        """Images with alpha of a static scene in a box."""
        return ball_in_a_box()

    @cached_property
    def scenes(self) -> dict[str, Dataset]:
        """Data sets of all scenes for the method, by the scenes' names in messages."""
        scenes = {"a still scene in a box": self.still}
        if not self.method.model.ends_at_box:
            scenes["photographs without alpha or box"] = ball_under_a_sky()
        if issubclass(self.method.model, LearnsMotion):
            scenes["a scene that moves"] = moving_ball()
        return scenes

    def learner(self, dataset: Dataset | None = None, seed: int = SEED) -> Learner:
        """Return a fresh model, of a random `seed`, on `dataset`, or on the static scene if that is None."""
        return Learner(self.method, self.config, dataset or self.still, seed)

    @cached_property
    def trained(self) -> Learner:
        """A model trained for STEPS steps on the static scene."""
        learner = self.learner()
        for _ in range(STEPS):
            learner.step()
        return learner

    def on_each_scene(self, look: Callable[[Learner], None]) -> None:
        """Call `look` with a fresh model on each of `scenes`.

        Raises:
            Fault: if `look` raises an error; the message names the scene.
        """
        for scene, dataset in self.scenes.items():
            try:
                look(self.learner(dataset))
            except Exception as error:
                raise Fault(f"on {scene}: {self.described(error)}") from error

    def described(self, error: Exception) -> str:
        """Return the message of an `error` on one line, with the last line of the method's file in its traceback."""
        if isinstance(error, Fault):
            return str(error)
        message = " ".join(f"{type(error).__name__}: {error}".split())[:300]
        file = getattr(sys.modules.get(type(self.method.config).__module__), "__file__", None)
        lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == file]
        return f"{message} ({Path(str(file)).name}, line {lines[-1]})" if lines else message
