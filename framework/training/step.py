"""One training step of any method: the trainer, the method checks and the stress tests all take it here."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from framework.model import Loss, Model
from framework.training.optim import Adam, set_learning_rate


@dataclass(frozen=True)
class StepResult:
    """What a step showed."""

    loss: Loss
    """The batch's loss; its terms still hold the graph."""
    squared_errors: Tensor
    """The mean over channels of each pixel's squared error, shaped as the batch's pixels."""
    finite: bool
    """Whether the loss and all gradients were; the step was dropped where they were not."""


def train_step(model: Model[Any], optimizer: Adam, batch: Any, step: int, progress: float) -> StepResult:
    """Take one step: forward, backward, Adam. A step that is not finite changes no parameter.

    Args:
        model: what is trained.
        optimizer: holds all of its parameters.
        batch: what is learnt from.
        step: training steps done.
        progress: share of the budget spent.
    """
    set_learning_rate(optimizer, model.config, step, progress)
    loss = forward(model, batch, step, progress, model.uses_bfloat16)
    finite = backward(loss.total, optimizer)
    if finite and loss.total.requires_grad:
        optimizer.step()
    if finite:
        for change in model.after_step(step, progress):
            optimizer.change_rows(change)
    squared_errors = (loss.rgb - batch.rgb).square().mean(-1)
    return StepResult(loss, squared_errors, finite)


def forward(model: Model[Any], batch: Any, step: int, progress: float, bfloat16: bool = False) -> Loss:
    """Return what a model makes of a batch, in training mode.

    Args:
        model: what is trained.
        batch: what is learnt from.
        step: training steps done.
        progress: share of the budget spent.
        bfloat16: run networks in bfloat16. It has float32's range, so no gradient scaling is needed.
    """
    model.train()
    with torch.autocast(model.device.type, torch.bfloat16, enabled=bfloat16):
        model.before_step(step, progress)
        return model.loss(batch, step)


def backward(loss: Tensor, optimizer: Adam) -> bool:
    """Leave the gradients of a loss where the optimiser finds them.

    Args:
        loss: a scalar. One without a gradient, as where every ray meets nothing, leaves none.
        optimizer: forgets the gradients of the step before.
    Returns: whether the loss and all gradients are finite.
    """
    optimizer.zero_grad(set_to_none=True)
    if not bool(torch.isfinite(loss)):
        return False
    if not loss.requires_grad:
        return True
    loss.backward()
    return optimizer.first_bad() is None
