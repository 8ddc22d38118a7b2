"""The interface of models: renderables that can be trained."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, Literal, Protocol, TypeVar, runtime_checkable

import torch
from torch import Tensor, nn

from nerfloom.base.config import RayConfig, TrainConfig
from nerfloom.base.device import has_bfloat16
from nerfloom.base.optimised import ParameterGroup, RowChange, parameter_groups
from nerfloom.base.pace import Pace
from nerfloom.base.step_kind import StepKind
from nerfloom.data.dataset import Dataset
from nerfloom.data.scene import Scene
from nerfloom.fields.appearance import Appearance
from nerfloom.kernels.native import torch_on_one_thread
from nerfloom.kernels.table_memory import IN_MEMORY, Tables
from nerfloom.renderable import Renderable, RendersRays, parts

ConfigT = TypeVar("ConfigT", bound=TrainConfig)
RayConfigT = TypeVar("RayConfigT", bound=RayConfig)


@dataclass(frozen=True)
class Loss:
    """The loss of a model on a batch."""

    terms: dict[str, Tensor]
    """Named scalars; training minimises their sum."""
    rgb: Tensor
    """Rendered colours in the batch's shape, for the running error and the choice of pixels."""
    num_samples: int | Tensor = 0
    """Number of evaluations of the field, () int64 if still on the device; 0 for a model without a field."""

    @property
    def total(self) -> Tensor:
        """Sum () of the terms."""
        return torch.stack(list(self.terms.values())).sum()


class Model(nn.Module, Renderable, Generic[ConfigT]):
    """Base class of models: renderables that can be trained.

    Sample positions are random if `self.training` is True and fixed otherwise.
    """

    batches: ClassVar[Literal["pixels", "views"]]
    """Kind of training batch: pixels of all images (`PixelBatch`; its settings are of `RayConfig`), or one whole image
    (`ViewBatch`)."""

    resizes: ClassVar[bool] = False
    """Whether `after_step` may change the rows of parameters."""

    ends_at_box: ClassVar[bool] = False
    """Whether it learns only scenes that end at their box; `Method.build` refuses others."""
    tables: Tables = IN_MEMORY
    """Place of the optimiser's state of sparse parameters, and of the parameters that `after_step` changes."""

    def __init__(self, config: ConfigT, scene: Scene) -> None:
        super().__init__()
        self.config = config
        self.scene = scene

    @abstractmethod
    def loss(self, batch: Any, step: int) -> Loss:
        """Return the loss on a `batch`, of the kind named by `batches`, after `step` training steps."""

    def before_step(self, step: int, progress: float) -> None:
        """Apply schedules and update samplers; called before training step `step`, at the spent fraction `progress`."""

    def step_kind(self, step: int) -> StepKind:
        """Return the kind of training step `step`, counted from 0; by default steps cannot be replayed."""
        return StepKind(varies="the method does not say that its steps repeat")

    def read_counts(self) -> None:
        """Read counts from the device and adapt sizes to them. The trainer calls this when it waits for the device."""

    def after_every_step(self, step: int, progress: float, finite: bool | Tensor) -> None:
        """Run after each training step, while its gradients exist, for example to accumulate statistics of them.

        Args:
            step: number of training steps done before this one.
            progress: fraction of the training budget that is spent.
            finite: whether the step was finite; () bool if still on the device, and then nothing may change where it is
                False. Not called for steps that are known to be dropped.
        """

    def changes_rows(self, step: int, progress: float) -> bool:
        """Return whether `after_step` may change rows now; the trainer then waits to know whether the step was finite.

        Args:
            step: number of training steps done before this one.
            progress: fraction of the training budget that is spent.
        """
        return self.resizes

    def after_step(self, step: int, progress: float) -> Sequence[RowChange]:
        """Return rows of parameters to add, drop or reorder; called after a training step if `changes_rows` is True.

        Args:
            step: number of training steps done before this one.
            progress: fraction of the training budget that is spent.
        """
        return ()

    def groups(self) -> list[ParameterGroup]:
        """Return the parameters, grouped by the `Optimised` settings of the modules that hold them."""
        return parameter_groups(self)

    @property
    def appearance(self) -> Appearance | None:
        """Appearance of the training images, of the part that has one; None if all images have the same."""
        return next(iter(parts(self, Appearance)), None)

    @property
    def samples_per_step(self) -> int | None:
        """Number of samples per training step, reached by adapting the number of pixels; None for fixed batches."""
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
        """True if networks run in bfloat16: as configured, or if the device supports it."""
        chosen = self.config.mixed_precision
        return has_bfloat16(self.device) if chosen is None else chosen

    @property
    def background(self) -> Tensor:
        """Return the background colour (3,): as configured, else white if images have alpha and black if not."""
        asked = self.config.background
        white = asked == "white" or (asked != "black" and self.scene.has_alpha)
        return torch.full((3,), float(white), device=self.device)

    @contextmanager
    def rendering(self) -> Iterator[None]:
        """Set evaluation mode, and the precision and threads for rendering, within a `with` block."""
        with (
            evaluating(self),
            torch_on_one_thread(self.runs_on_kernels),
            torch.autocast(self.device.type, torch.bfloat16, enabled=self.uses_bfloat16),
        ):
            yield

    def size(self) -> int:
        """Return the number of trainable parameters."""
        return sum(parameter.numel() for parameter in self.parameters())


class PixelModel(Model[RayConfigT], RendersRays, Generic[RayConfigT]):
    """Base class of models that learn from single pixels, by their rays."""

    batches: ClassVar[Literal["pixels", "views"]] = "pixels"

    @property
    def rays_at_once(self) -> int:
        """Maximum number of rays to render at once, as configured."""
        return self.config.eval_num_rays_per_chunk

    @property
    def rays_per_pixel(self) -> int:
        """Number of rays averaged per pixel, as configured."""
        return self.config.rays_per_pixel


@contextmanager
def evaluating(model: nn.Module) -> Iterator[None]:
    """Set a `model`, or a part of one, to evaluation mode within a `with` block, and restore its mode afterwards."""
    was_training = model.training
    model.eval()
    try:
        yield
    finally:
        model.train(was_training)


# -- optional capabilities ----------------------------------------------------------------------------------------


class LearnsMotion:
    """A model of a moving scene; it uses the images' times."""


@runtime_checkable
class StartsFromImages(Protocol):
    """A model that initialises its parameters from the images, before the first step."""

    def start(self, dataset: Dataset) -> None:
        """Initialise the parameters of a new model from the training images `dataset`, on the model's device."""


@runtime_checkable
class KeepsPace(Protocol):
    """A model that adapts sizes to the speed of its steps, in a run with a time budget."""

    def keep_pace(self, pace: Pace) -> None:
        """Adapt sizes to the time of the last steps; called before each training step, with the run's `pace`."""
