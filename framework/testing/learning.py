"""Checks of a model's loss and gradients, and of training: that it is reproducible and reduces the error.

Each check returns a line for people, and raises Fault if it fails.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from nerfloom.model import Loss
from nerfloom.ray_model import RayModel
from nerfloom.testing.finding import Fault
from nerfloom.testing.method_under_test import STEPS, Learner, MethodUnderTest
from nerfloom.testing.rendering import require_rendered
from nerfloom.training.optim import first_non_finite

FIRST_STEPS = 3
"""Number of steps with checked gradients."""
GRADIENT_STEPS = 40
"""Each parameter must have a gradient within this number of steps; proposals have one only where they are too low."""
REPEATED_STEPS = 2
"""Number of steps before two models are compared."""
RAYS_PER_PIXEL = 4
"""Rays per pixel of the second checked batch."""
MAX_ERROR_RATIO = 0.8
"""Maximum error after STEPS steps, as a fraction of the initial one."""


def check_loss(subject: MethodUnderTest) -> str:
    """Check that the loss of `subject` is finite named scalars with a gradient, with one and several rays per pixel."""

    def look(learner: Learner) -> None:
        for count in (1, RAYS_PER_PIXEL) if learner.model.batches == "pixels" else (1,):
            batch = learner.batch(count)
            _require_loss(learner.loss(batch), batch, "" if count == 1 else f" of {count} rays a pixel")

    subject.on_each_scene(look)
    return "named scalars, finite, with a gradient"


def _require_loss(loss: Loss, batch: Any, of: str) -> None:
    if not isinstance(loss, Loss):
        raise Fault(f"the loss{of} is {type(loss).__name__}; return a nerfloom.Loss")
    if not isinstance(loss.terms, dict) or not loss.terms:
        raise Fault(f"the loss{of} has {type(loss.terms).__name__}, or none; its terms are a dictionary of scalars")
    for name, value in loss.terms.items():
        if not isinstance(value, Tensor) or value.ndim:
            shape = tuple(value.shape) if isinstance(value, Tensor) else value
            raise Fault(f"the loss{of} '{name}' is {shape}, not a scalar tensor; take its mean")
        if not bool(torch.isfinite(value)):
            raise Fault(f"the loss{of} '{name}' is {float(value.detach())} in the first step")
    if loss.rgb.shape != batch.rgb.shape or loss.rgb.requires_grad:
        raise Fault(f"the colours returned with the loss{of} must have the batch's shape and be detached")
    if not loss.total.requires_grad:
        raise Fault(f"no loss{of} has a gradient; is something detached, or computed under torch.no_grad()?")


def check_groups(subject: MethodUnderTest) -> str:
    """Check that the `groups` of `subject` have every parameter exactly once."""

    def look(learner: Learner) -> None:
        names = {id(parameter): name for name, parameter in learner.model.named_parameters()}
        counts = Counter(id(p) for group in learner.model.groups() for p in group.parameters)
        if others := counts.keys() - names.keys():
            raise Fault(
                f"groups() has {len(others)} tensors that are not parameters of the model; "
                "make each an attribute that is a torch.nn.Parameter"
            )
        if twice := [names[key] for key, count in counts.items() if count > 1]:
            raise Fault(f"{_names(twice)} more than once in groups()")
        if missing := [name for name, p in learner.model.named_parameters() if p.requires_grad and not counts[id(p)]]:
            raise Fault(f"{_names(missing)} in no group of groups(), and never updated")

    subject.on_each_scene(look)
    return "every parameter is in one group"


def check_gradients(subject: MethodUnderTest) -> str:
    """Check that parameters of `subject` and their gradients are finite in the first steps."""

    def look(learner: Learner) -> None:
        for step in range(FIRST_STEPS):
            learner.step_backward()
            if (bad := first_non_finite(learner.model, learner.optimizer)) is not None:
                raise Fault(f"{bad} is not finite in step {step}")
            learner.descend()

    subject.on_each_scene(look)
    return "finite in the first steps"


def check_unused(subject: MethodUnderTest) -> str:
    """Check that parameters of `subject` that require a gradient have one within GRADIENT_STEPS steps."""

    def look(learner: Learner) -> None:
        unused = {name for name, parameter in learner.model.named_parameters() if parameter.requires_grad}
        for _ in range(GRADIENT_STEPS):
            learner.step_backward()
            unused -= {name for name, p in learner.model.named_parameters() if _has_gradient(learner, p)}
            if not unused:
                return
            learner.descend()
        raise Fault(
            f"{_names(sorted(unused))} without a gradient, or with one of zeros, in each of {GRADIENT_STEPS} steps; "
            "use it, or set requires_grad to False"
        )

    subject.on_each_scene(look)
    return "every parameter gets a gradient"


def _has_gradient(learner: Learner, parameter: Tensor) -> bool:
    """Return whether any entry has a nonzero gradient; gradients of sparse tables may be deferred."""
    deferred = learner.optimizer.deferred.get(parameter)
    if deferred is not None and deferred.pending:
        return True
    return parameter.grad is not None and bool((parameter.grad != 0).any())


def _names(names: list[str]) -> str:
    """Return up to four of the names, as the subject of a sentence."""
    some = ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
    return f"{some} {'is' if len(names) == 1 else 'are'}"


def check_repetition(subject: MethodUnderTest) -> str:
    """Check that training `subject` is reproducible: the same seed gives the same bits."""
    learners = [subject.learner(), subject.learner()]
    for learner in learners:
        for _ in range(REPEATED_STEPS):
            learner.step()
    require_same(learners[0], learners[1], f"after {REPEATED_STEPS} steps with the same seed", "draw with torch only")
    return "two models of one seed are the same after two steps, bit for bit"


def require_same(one: Learner, other: Learner, when: str, remedy: str) -> None:
    """Check that the parameters and buffers of two models are equal to the bit.

    Args:
        one, other: the models.
        when: start of the message, such as "after 2 steps".
        remedy: end of the message with advice.

    Raises:
        Fault: if a parameter or buffer differs.
    """
    first, second = one.model.state_dict(), other.model.state_dict()
    different = [name for name, value in first.items() if not torch.equal(value, second[name])]
    if different:
        raise Fault(f"{when}, {_names(different)} different; {remedy}")


def check_training(subject: MethodUnderTest) -> str:
    """Check that training `subject` for STEPS steps raises no error and that the loss stays finite."""
    history = subject.trained.history
    bad = [step for step, loss in enumerate(history) if not math.isfinite(loss)]
    if bad:
        raise Fault(f"the loss is not finite in {len(bad)} of {STEPS} steps, the first being step {bad[0]}")
    return f"{STEPS} steps"


def check_learning(subject: MethodUnderTest) -> str:
    """Check that training `subject` for STEPS steps reduces the squared error of images."""
    before, after = subject.learner().error(), subject.trained.error()
    change = f"from {before:.3g} to {after:.3g} in {STEPS} steps"
    if not after < MAX_ERROR_RATIO * before:
        raise Fault(
            f"the squared error goes {change}; check the loss's sign and the learning rates, or give a config with a "
            "smaller model and a higher --learning-rate"
        )
    return f"the squared error falls {change}"


def check_nan_colors(subject: MethodUnderTest) -> str:
    """Check that a NaN in an image makes the loss of `subject` NaN, so that the trainer drops the step."""
    learner = subject.learner()
    batch = learner.batch()
    rgb = batch.rgb.clone()
    rgb.view(-1, 3)[0] = torch.nan
    loss = learner.loss(replace(batch, rgb=rgb))
    if bool(torch.isfinite(loss.total)):
        raise Fault("a NaN in a batch's colours leaves the loss finite; let it through, the trainer drops the step")
    return "a NaN in a photograph makes the loss NaN, and the trainer drops the step"


def check_bfloat16(subject: MethodUnderTest) -> str:
    """Check that a step of `subject` under bfloat16 autocast works, with finite float32 colours and losses."""

    def look(learner: Learner) -> None:
        batch = learner.batch()
        if isinstance(learner.model, RayModel):
            with torch.autocast("cpu", torch.bfloat16):
                rendered = learner.rendered(batch.rays, batch.background)
            require_rendered(rendered, len(batch.rays), "under autocast")
        loss = learner.loss(batch, bfloat16=True)
        _require_loss(loss, batch, " under autocast")
        learner.backward(loss)
        if (bad := first_non_finite(learner.model, learner.optimizer)) is not None:
            raise Fault(f"under autocast {bad} is not finite")

    subject.on_each_scene(look)
    return "a step under torch.autocast gives a finite float32 picture"
