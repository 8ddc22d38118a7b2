"""The interface of models, which the trainer uses: things to look at that learn."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, Literal, Protocol, TypeVar, runtime_checkable

import torch
from torch import Tensor, nn

from nerfloom.base.config import TrainConfig
from nerfloom.base.device import has_bfloat16
from nerfloom.base.optimised import ParameterGroup, RowChange, parameter_groups
from nerfloom.base.pace import Pace
from nerfloom.base.step_kind import StepKind
from nerfloom.data.dataset import Dataset
from nerfloom.data.scene import Scene
from nerfloom.kernels.native import torch_on_one_thread
from nerfloom.renderable import Renderable

ConfigT = TypeVar("ConfigT", bound=TrainConfig)


@dataclass(frozen=True)
class Loss:
    """The loss of a model on a batch."""

    terms: dict[str, Tensor]
    """Named scalars; their sum is minimised."""
    rgb: Tensor
    """Rendered colours, with the shape of the batch's; for the running error and the choice of pixels."""
    num_samples: int | Tensor = 0
    """Number of evaluations of the field, () int64 if the device alone knows it; 0 for a model without a field."""

    @property
    def total(self) -> Tensor:
        """Sum () of the terms, which is minimised."""
        return torch.stack(list(self.terms.values())).sum()


class Model(nn.Module, Renderable, Generic[ConfigT]):
    """Base class of models: things to look at that learn.

    Samples are at random positions if `self.training` is True, and at fixed positions if it is False.
    """

    batches: ClassVar[Literal["pixels", "views"]]
    """Kind of the training batches: pixels of all images (`PixelBatch`), or one whole image (`ViewBatch`)."""

    def __init__(self, config: ConfigT, scene: Scene) -> None:
        super().__init__()
        self.config = config
        self.scene = scene

    @abstractmethod
    def loss(self, batch: Any, step: int) -> Loss:
        """Return the loss on a batch.

        Args:
            batch: a `PixelBatch` or a `ViewBatch`, according to `batches`.
            step: number of training steps done.
        """

    def before_step(self, step: int, progress: float) -> None:
        """Apply schedules and update samplers; called before each training step.

        Args:
            step: number of training steps done.
            progress: fraction of the training budget that is spent.
        """

    def step_kind(self, step: int) -> StepKind:
        """Return what a training step computes besides the values of tensors; by default, steps do not repeat.

        Args:
            step: number of training steps done.
        """
        return StepKind(varies="the method does not say that its steps repeat each other")

    def read_counts(self) -> None:
        """Read what was counted on the device, and decide on sizes by it; called where the device is waited for."""

    def after_every_step(self, step: int, progress: float, finite: bool | Tensor) -> None:
        """Do what follows each training step, with its gradients in place, such as to add up what they say.

        Args:
            step: number of training steps done before this one.
            progress: fraction of the training budget that is spent.
            finite: whether the step counts; if this is still on the device, () bool, nothing may change where it is
                False. Steps that Python knows not to count are not followed by anything.
        """

    def changes_rows(self, step: int, progress: float) -> bool:
        """Return whether `after_step` may have something to do, for which Python must know whether the step counts.

        Args:
            step: number of training steps done before this one.
            progress: fraction of the training budget that is spent.
        """
        return type(self).after_step is not Model.after_step

    def after_step(self, step: int, progress: float) -> Sequence[RowChange]:
        """Return rows of parameters to add, drop or reorder; called after a training step if `changes_rows` says so.

        Args:
            step: number of training steps done before this one.
            progress: fraction of the training budget that is spent.
        """
        return ()

    def groups(self) -> list[ParameterGroup]:
        """Return the parameters, grouped by the `Optimised` settings of the modules that hold them."""
        return parameter_groups(self)

    @property
    def samples_per_step(self) -> int | None:
        """Number of samples per training step, to which the number of pixels is adapted; None for a fixed one."""
        return None

    @property
    def runs_on_kernels(self) -> bool:
        """True if compiled kernels do most of the work; torch's own operations then use one CPU thread."""
        return False

    @property
    def device(self) -> torch.device:
        """Return the device of the parameters."""
        return next(self.parameters()).device

    @property
    def uses_bfloat16(self) -> bool:
        """True if networks run in bfloat16: as configured, or else if the device supports it."""
        chosen = self.config.mixed_precision
        return has_bfloat16(self.device) if chosen is None else chosen

    @property
    def background(self) -> Tensor:
        """Return the background colour (3,) of training; if it is random or automatic, white if images have alpha."""
        asked = self.config.background
        white = asked == "white" or (asked != "black" and self.scene.has_alpha)
        return torch.full((3,), float(white), device=self.device)

    @contextmanager
    def rendering(self) -> Iterator[None]:
        """Within a `with` block, put the model in evaluation mode, with the precision and threads of pictures."""
        with (
            evaluating(self),
            torch_on_one_thread(self.runs_on_kernels),
            torch.autocast(self.device.type, torch.bfloat16, enabled=self.uses_bfloat16),
        ):
            yield

    def size(self) -> int:
        """Return the number of trainable parameters."""
        return sum(parameter.numel() for parameter in self.parameters())


@contextmanager
def evaluating(model: nn.Module) -> Iterator[None]:
    """Put a model into evaluation mode within a `with` block, and back into the mode it was in, also after an error.

    Args:
        model: the model, or a part of one.
    """
    was_training = model.training
    model.eval()
    try:
        yield
    finally:
        model.train(was_training)


# -- optional capabilities ----------------------------------------------------------------------------------------


class LearnsMotion:
    """A model of a moving scene, which uses the times of the images."""


@runtime_checkable
class StartsFromImages(Protocol):
    """A model whose parameters are first set by the images, before the first step."""

    def start(self, dataset: Dataset) -> None:
        """Set the parameters of a fresh model.

        Args:
            dataset: images to learn from, on the model's device.
        """


@runtime_checkable
class KeepsPace(Protocol):
    """A model that chooses sizes by how fast its steps are, in a run with a budget in seconds."""

    def keep_pace(self, pace: Pace) -> None:
        """Take the time of the last steps into account; called before each training step.

        Args:
            pace: the run before the step.
        """
