"""One training step of any method, used by the trainer, the method checks and the stress tests."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from framework.base.device import AFTER_STEP, BEFORE_STEP, shared_stream
from framework.kernels.given import is_bad_here
from framework.model import Loss, Model
from framework.training.mean_gradients import mean_gradients
from framework.training.optim import Adam, set_learning_rate


@dataclass(frozen=True)
class StepResult:
    """Result of a training step."""

    loss: Loss
    """Loss of the batch; its terms still hold the graph."""
    squared_errors: Tensor
    """Squared error of each pixel, a mean over channels, in the shape of the batch's pixels."""
    finite: bool
    """Whether the loss and all gradients were finite, in every process; if not, the step was dropped."""


def train_step(model: Model[Any], optimizer: Adam, batch: Any, step: int, progress: float) -> StepResult:
    """Take one training step: forward, backward, Adam. A step that is not finite changes no parameter.

    Several processes take the step together, each with its own batch and all with the mean gradient.

    Args:
        model: the model to train.
        optimizer: the optimiser of all its parameters.
        batch: pixels or views, as the model's loss takes them.
        step: number of training steps done.
        progress: fraction of the budget spent, 0 to 1.
    """
    set_learning_rate(optimizer, model.config, step, progress)
    loss = forward(model, batch, step, progress, model.uses_bfloat16)
    finite = mean_gradients(optimizer, backward(loss.total, optimizer))
    if finite:
        optimizer.step()
        with shared_stream(model.config.machine.seed, step, AFTER_STEP):
            changes = model.after_step(step, progress)
        for change in changes:
            optimizer.change_rows(change)
    squared_errors = (loss.rgb - batch.rgb).square().mean(-1)
    return StepResult(loss, squared_errors, finite)


def forward(model: Model[Any], batch: Any, step: int, progress: float, bfloat16: bool = False) -> Loss:
    """Return the loss of a model on a batch, in training mode.

    Args:
        model: the model to train.
        batch: pixels or views, as the model's loss takes them.
        step: number of training steps done.
        progress: fraction of the budget spent, 0 to 1.
        bfloat16: whether networks run in bfloat16, which has the range of float32 and needs no gradient scaling.
    """
    model.train()
    with torch.autocast(model.device.type, torch.bfloat16, enabled=bfloat16):
        with shared_stream(model.config.machine.seed, step, BEFORE_STEP):
            model.before_step(step, progress)
        return model.loss(batch, step)


def backward(loss: Tensor, optimizer: Adam) -> bool:
    """Compute the gradients of a loss, for the optimiser's next step.

    Args:
        loss: a scalar; without a graph, as when no ray has a sample, all gradients stay empty.
        optimizer: the optimiser, whose gradients of the previous step are cleared.

    Returns:
        Whether the loss and all gradients are finite.
    """
    optimizer.zero_grad()
    if is_bad_here(loss):
        return False
    if loss.requires_grad:
        loss.backward()
    if optimizer.finite(loss):
        return True
    if not bool(torch.isfinite(loss)):
        optimizer.zero_grad()  # so that the loss is found to be the first that is bad
    return False
