"""What the trainer, the evaluator and the commands know of a method."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, Literal, Protocol, TypeVar, cast, runtime_checkable

import torch
from torch import Tensor, nn

from framework.base.config import TrainConfig
from framework.base.device import has_bfloat16
from framework.base.optimised import ParameterGroup, RowChange, parameter_groups
from framework.cameras.cameras import Cameras
from framework.cameras.view import View
from framework.data.dataset import Dataset
from framework.data.scene import Scene
from framework.fields.appearance import Appearance
from framework.geometry.points import Points
from framework.rendering.rendered import Picture

ConfigT = TypeVar("ConfigT", bound=TrainConfig)
PartT = TypeVar("PartT")


@dataclass(frozen=True)
class Loss:
    """What a model makes of a batch."""

    terms: dict[str, Tensor]
    """Named scalars; their sum is minimised."""
    rgb: Tensor
    """The colours that it showed, shaped like the batch's; for the running error and the choice of pixels."""
    num_samples: int = 0
    """Evaluations of the field; 0 of a method that has none."""

    @property
    def total(self) -> Tensor:
        """What is minimised."""
        return torch.stack(list(self.terms.values())).sum()


class Model(nn.Module, ABC, Generic[ConfigT]):
    """What is trained and rendered. `self.training` tells random sampling (True) from fixed (False).

    Args:
        config: the method's settings, decided.
        scene: facts about the data.
    """

    batches: ClassVar[Literal["pixels", "views"]]
    """What it learns from: pixels of all images (`PixelBatch`), or one whole image (`ViewBatch`)."""

    def __init__(self, config: ConfigT, scene: Scene) -> None:
        super().__init__()
        self.config = config
        self.scene = scene

    @abstractmethod
    def loss(self, batch: Any, step: int) -> Loss:
        """Return what is to be minimised on a batch.

        Args:
            batch: a `PixelBatch` or a `ViewBatch`, as `batches` says.
            step: training steps done.
        """

    @abstractmethod
    def render_view(self, view: View, background: Tensor) -> Picture:
        """Return what a camera sees, in evaluation mode and without gradient.

        Args:
            view: the camera, on the model's device.
            background: (3,) colour behind what is not opaque.
        """

    def before_step(self, step: int, progress: float) -> None:
        """Follow schedules and refresh samplers, before a training step.

        Args:
            step: training steps done.
            progress: share of the budget spent.
        """

    def after_step(self, step: int, progress: float) -> Sequence[RowChange]:
        """Return rows of parameters to add, drop or reorder, after a training step; gradients are still there.

        Args:
            step: training steps done before it.
            progress: share of the budget spent.
        """
        return ()

    def groups(self) -> list[ParameterGroup]:
        """Return the parameters, grouped as the modules that hold them say (`Optimised`)."""
        return parameter_groups(self)

    @property
    def samples_per_step(self) -> int | None:
        """Samples a training step should evaluate, the number of pixels following; None for a fixed number."""
        return None

    @property
    def rays_per_pixel(self) -> int:
        """Rays of which a pixel of a picture is the mean, where the view does not say."""
        return 1

    @property
    def runs_on_kernels(self) -> bool:
        """Whether compiled kernels do the heavy work: then torch's own operations keep to one CPU thread."""
        return False

    @property
    def device(self) -> torch.device:
        """Where the parameters are."""
        return next(self.parameters()).device

    @property
    def uses_bfloat16(self) -> bool:
        """Whether networks run in bfloat16: as configured, else as the device allows."""
        chosen = self.config.mixed_precision
        return has_bfloat16(self.device) if chosen is None else chosen

    def size(self) -> int:
        """Return the number of trainable parameters."""
        return sum(parameter.numel() for parameter in self.parameters())


# -- what some models can do --------------------------------------------------------------------------------------


class LearnsMotion:
    """A model that uses the images' times."""


@runtime_checkable
class StartsFromImages(Protocol):
    """A model whose parameters are first set by the images, before the first step."""

    def start(self, dataset: Dataset) -> None:
        """Set the parameters of a fresh model.

        Args:
            dataset: images to learn from, on the model's device.
        """


@runtime_checkable
class HasAppearance(Protocol):
    """A model that can give each image an appearance of its own."""

    appearance: Appearance | None
    """The images' vectors; None where the settings or the scene leave them out."""


@runtime_checkable
class RefinesPoses(Protocol):
    """A model that can refine the training cameras' poses."""

    def refined_cameras(self, cameras: Cameras) -> Cameras:
        """Return the training cameras where they are believed to be after training.

        Args:
            cameras: M training cameras as they are given.
        """


@runtime_checkable
class HasDensity(Protocol):
    """A model that knows density anywhere."""

    def density(self, points: Points) -> Tensor:
        """Return density (N,), 1/length.

        Args:
            points: N points, scene coordinates.
        """


def parts(model: nn.Module, kind: Callable[..., PartT]) -> list[PartT]:
    """Return the modules of a model that have a capability.

    Args:
        model: whose modules are looked at.
        kind: a protocol or class, as in `parts(model, SkipsCells)`.
    """
    return [module for module in model.modules() if isinstance(module, cast("type[PartT]", kind))]
