"""Adam and the learning rate over a run."""

from __future__ import annotations

import torch

from framework.config import TrainConfig
from framework.model import Model


def make_optimizer(model: Model, config: TrainConfig) -> torch.optim.Adam:
    """Adam over the model's parameter groups, each remembering the rate it starts from as `initial_lr`."""
    groups = []
    for group in model.param_groups():
        rate = group.get("lr", config.learning_rate)
        groups.append({**group, "lr": rate, "initial_lr": rate})
    return torch.optim.Adam(
        groups,
        lr=config.learning_rate,
        betas=(config.adam_beta1, config.adam_beta2),
        eps=config.adam_eps,
        fused=model.device.type in ("cpu", "cuda"),
    )


def learning_rate_factor(config: TrainConfig, step: int, progress: float) -> float:
    """What to multiply a group's first learning rate by.

    Args:
        config: the schedule's name, final share and warm-up.
        step: steps done.
        progress: share of the budget spent, 0 to 1.
    """
    progress = min(max(progress, 0.0), 1.0)
    warm_up = min(1.0, (step + 1) / config.lr_warmup_steps) if config.lr_warmup_steps else 1.0
    return warm_up * _decay(config.lr_schedule, config.lr_final, progress)


def _decay(schedule: str, final: float, progress: float) -> float:
    if schedule == "constant":
        return 1.0
    if schedule == "exponential":
        return float(final**progress)
    if schedule == "hold-exponential":
        return float(final ** max(0.0, 2 * progress - 1))
    return final + (1 - final) * 0.5 * (1 + float(torch.tensor(progress * torch.pi).cos()))


def set_learning_rate(optimizer: torch.optim.Optimizer, factor: float) -> None:
    """Every group at its first rate times `factor`."""
    for group in optimizer.param_groups:
        group["lr"] = group["initial_lr"] * factor


def first_non_finite(model: Model) -> str | None:
    """The name of the first parameter that is not finite, or whose gradient is not; None where all are."""
    for name, parameter in model.named_parameters():
        if not bool(torch.isfinite(parameter).all()):
            return name
        if parameter.grad is not None and not bool(torch.isfinite(parameter.grad).all()):
            return f"{name}.grad"
    return None
