"""One training step of any method, used by the trainer, the method checks and the stress tests."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from nerfloom.base.device import AFTER_STEP, BEFORE_STEP, shared_stream
from nerfloom.kernels.argument_checks import is_bad_here
from nerfloom.model import Loss, Model
from nerfloom.training.mean_gradients import mean_gradients
from nerfloom.training.optim import Adam, set_learning_rate


@dataclass(frozen=True)
class StepResult:
    """Result of a training step."""

    loss: Loss
    """Loss of the batch; its terms still hold the graph."""
    squared_errors: Tensor
    """Squared errors in the shape of the batch's `rgb`. Torch takes much longer for a mean over the three channels of
    each pixel than for one over all values, so a step computes neither."""
    finite: bool | Tensor
    """Whether the loss and all gradients were finite in every process; if not, the step was dropped. () bool if still
    on the device."""

    def detached(self) -> StepResult:
        """Return the result without the graph of its loss."""
        terms = {name: value.detach() for name, value in self.loss.terms.items()}
        return replace(self, loss=replace(self.loss, terms=terms))


def train_step(model: Model[Any], optimizer: Adam, batch: Any, step: int, progress: float) -> StepResult:
    """Take one training step: forward, backward, Adam. A non-finite step changes no parameter.

    Several processes take the step together, each with its own batch; all use the mean gradient.

    Args:
        optimizer: the optimiser of all its parameters.
        batch: pixels or views, as the model's loss takes them.
        step: number of training steps done.
        progress: fraction of the budget spent, 0 to 1.
    """
    schedule(model, optimizer, step, progress)
    return learn(model, optimizer, batch, step, progress)


def schedule(model: Model[Any], optimizer: Adam, step: int, progress: float) -> None:
    """Set learning rates and the model's schedules for a step.

    `model`, `optimizer`, `step` and `progress` are as in `train_step`.
    """
    set_learning_rate(optimizer, model.config, step, progress)
    _before(model, step, progress, model.uses_bfloat16)


def learn(model: Model[Any], optimizer: Adam, batch: Any, step: int, progress: float) -> StepResult:
    """Take the rest of a training step, after `schedule`: forward, backward, Adam.

    If steps can be replayed (`Model.step_kind`), this depends only on the values of tensors. `model`, `optimizer`,
    `batch`, `step` and `progress` are as in `train_step`.
    """
    loss = _loss(model, batch, step, model.uses_bfloat16)
    finite = mean_gradients(optimizer, backward(loss.total, optimizer))
    if changes := model.changes_rows(step, progress):
        finite = bool(finite)
    if finite is not False:
        optimizer.step(finite)
        with shared_stream(model.config.machine.seed, step, AFTER_STEP):
            model.after_every_step(step, progress, finite)
            rows = model.after_step(step, progress) if changes else ()
        for change in rows:
            optimizer.change_rows(change)
    squared_errors = (loss.rgb - batch.rgb).square()
    return StepResult(loss, squared_errors, finite)


def forward(model: Model[Any], batch: Any, step: int, progress: float, bfloat16: bool = False) -> Loss:
    """Return the loss of `model` on a `batch` after `step` steps, at the spent share `progress`, in training mode.

    Networks run in bfloat16 with `bfloat16`; it has the range of float32 and needs no gradient scaling.
    """
    _before(model, step, progress, bfloat16)
    return _loss(model, batch, step, bfloat16)


def _before(model: Model[Any], step: int, progress: float, bfloat16: bool) -> None:
    model.train()
    with (
        torch.autocast(model.device.type, torch.bfloat16, enabled=bfloat16),
        shared_stream(model.config.machine.seed, step, BEFORE_STEP),
    ):
        model.before_step(step, progress)


def _loss(model: Model[Any], batch: Any, step: int, bfloat16: bool) -> Loss:
    with torch.autocast(model.device.type, torch.bfloat16, enabled=bfloat16):
        return model.loss(batch, step)


def backward(loss: Tensor, optimizer: Adam) -> bool | Tensor:
    """Compute the gradients of a loss, for the optimiser's next step.

    Args:
        loss: a scalar. Without a graph, for example if no ray has a sample, all gradients stay empty.
        optimizer: the optimiser; gradients of the previous step are cleared.

    Returns:
        Whether the loss and all gradients are finite; () bool if still on the device.
    """
    optimizer.zero_grad()
    if is_bad_here(loss):
        return False
    if loss.requires_grad:
        loss.backward()
    finite = optimizer.finite(loss)
    if finite is False and not bool(torch.isfinite(loss)):
        optimizer.zero_grad()  # so that the error names the loss
    return finite
