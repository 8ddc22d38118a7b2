"""Adam, and the learning rate over a run."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from nerfloom.base.config import TrainConfig
from nerfloom.base.device import StepValue
from nerfloom.base.optimised import DefersGradient, ParameterGroup, RowChange
from nerfloom.kernels.adam.adam import all_finite, dense_adam, sparse_adam
from nerfloom.kernels.adam.deferred import DeferredGradient
from nerfloom.kernels.table_memory import IN_MEMORY, Tables, require
from nerfloom.model import Model
from nerfloom.renderable import parts

LATE = 0.85
"""Share of the budget before the learning rate falls with the schedule "fall-late"."""


class Adam:
    """Adam (Kingma and Ba 2015), with a sparse variant for groups with `sparse` set.

    A sparse group holds tables (E, F), and a step uses few of their entries (`kernels.adam.adam`). The gradient of a
    table is its entry of `deferred`, or else `grad`.

    Groups and states have the form of PyTorch's optimisers. The class does not derive from them, since that imports
    PyTorch's compiler, which takes longer than everything else before the first step.

    Args:
        groups: parameter groups.
        deferred: gradients that autograd does not accumulate, by table.
        lr, betas, eps: defaults for groups without their own.
        tables: place of the state of sparse groups.
    """

    def __init__(
        self,
        groups: list[dict[str, Any]],
        deferred: Mapping[Any, DeferredGradient],
        lr: float,
        betas: tuple[float, float],
        eps: float,
        tables: Tables = IN_MEMORY,
    ) -> None:
        defaults: dict[str, Any] = {"lr": lr, "betas": betas, "eps": eps, "sparse": False}
        self.param_groups = [defaults | group | {"params": list(group["params"])} for group in groups]
        """Settings of each group, with its parameters as `params`; settings may change between steps."""
        self.state: dict[Tensor, dict[str, Tensor]] = {}
        """Moments and counts of each parameter."""
        self.deferred, self.tables = deferred, tables
        self._rates: list[StepValue] = []
        device = next((parameter.device for parameter in self.parameters), None)
        self._entries, self._entries_on_device = [0, 0], torch.zeros(2, dtype=torch.int64, device=device)
        for group in self.param_groups:
            for parameter in group["params"]:
                self._begin(parameter, group["sparse"])

    def _begin(self, parameter: Tensor, sparse: bool) -> None:
        state: dict[str, Tensor] = {}
        self.state[parameter] = state
        tables = self._tables(sparse)
        state["exp_avg"], state["exp_avg_sq"] = (tables.zeros(*parameter.shape, like=parameter) for _ in range(2))
        if sparse:
            state["seen"] = tables.zeros(len(parameter), like=parameter)
        else:
            state["step"] = torch.zeros((), dtype=torch.float32, device=parameter.device)

    def _tables(self, sparse: bool) -> Tables:
        """Return the place of the state of a group's parameters."""
        return self.tables if sparse else IN_MEMORY

    @property
    def entries(self) -> tuple[int, int]:
        """Updated entries and existing entries of sparse groups, both summed over all steps."""
        updated, there = (a + b for a, b in zip(self._entries, self._entries_on_device.tolist(), strict=True))
        return updated, there

    @property
    def parameters(self) -> list[Tensor]:
        """The parameters of all groups, in order."""
        return [parameter for group in self.param_groups for parameter in group["params"]]

    def tensors(self) -> list[Tensor]:
        """Return the state tensors of all parameters, and the counts on the device."""
        return [*(t for p in self.parameters for t in self.state[p].values()), self._entries_on_device]

    def state_dict(self) -> dict[str, Any]:
        """Return groups and states for a checkpoint, in the format of PyTorch's optimisers."""
        numbers = {parameter: number for number, parameter in enumerate(self.parameters)}
        groups = [group | {"params": [numbers[p] for p in group["params"]]} for group in self.param_groups]
        return {"state": {numbers[p]: dict(state) for p, state in self.state.items()}, "param_groups": groups}

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        """Continue with groups and states from `state_dict`, or from a PyTorch optimiser with the same groups.

        Args:
            saved: content of a checkpoint. Its tensors in memory are not copied, and later steps change them.

        Raises:
            ValueError: if the number of groups, or of parameters in a group, differs.
        """
        own, groups = self.param_groups, saved["param_groups"]
        if [len(group["params"]) for group in groups] != [len(group["params"]) for group in own]:
            raise ValueError("its parameter groups differ")
        numbers = [number for group in groups for number in group["params"]]
        tables = [self._tables(group["sparse"]) for group in own for _ in group["params"]]
        self.state = {
            parameter: {name: place.kept(value.to(parameter.device)) for name, value in saved["state"][number].items()}
            for parameter, number, place in zip(self.parameters, numbers, tables, strict=True)
        }
        self.param_groups = [a | b | {"params": a["params"]} for a, b in zip(own, groups, strict=True)]

    def zero_grad(self) -> None:
        """Clear all gradients, deferred ones included; they become None."""
        for parameter in self.parameters:
            parameter.grad = None
        for gradient in self.deferred.values():
            gradient.clear()

    def first_bad(self) -> Tensor | None:
        """Return the first parameter with a gradient that is not finite; None if all are finite."""
        return next((p for p in self.parameters if not all_finite(self._gradients(p))), None)

    def has_gradient(self, parameter: Tensor) -> bool:
        """Return whether a `parameter` has a gradient for the next step, deferred or not."""
        deferred = self.deferred.get(parameter)
        return parameter.grad is not None or (deferred is not None and deferred.pending)

    @torch.no_grad()
    def gradient(self, parameter: Tensor) -> Tensor:
        """Return the gradient of a `parameter` as its `grad`, including its deferred part; zeros if there is none."""
        deferred = self.deferred.get(parameter)
        if deferred is not None and deferred.pending:
            total = deferred.summed(parameter)
            parameter.grad = total if parameter.grad is None else total.add_(parameter.grad)
        elif parameter.grad is None:
            parameter.grad = torch.zeros_like(parameter)
        return parameter.grad

    def finite(self, loss: Tensor) -> bool | Tensor:
        """Return whether a loss and all gradients are finite; () bool if still on the device.

        Args:
            loss: a scalar.
        """
        return all_finite([loss.detach(), *(grad for p in self.parameters for grad in self._gradients(p))])

    def _gradients(self, parameter: Tensor) -> list[Tensor]:
        """Return the gradient of a parameter and its deferred parts; empty if it has none."""
        deferred = self.deferred.get(parameter)
        own = [] if parameter.grad is None else [parameter.grad]
        return own if deferred is None else own + deferred.gradients

    def bring_rates(self) -> None:
        """Copy the groups' learning rates to asynchronous devices, for the next steps."""
        self._rates = self._rates or [StepValue(group["lr"]) for group in self.param_groups]
        for rate, group in zip(self._rates, self.param_groups, strict=True):
            rate.set(group["lr"])

    def _rate(self, index: int, device: torch.device) -> float | Tensor:
        brought = self._rates[index].on(device) if self._rates else None
        rate: float = self.param_groups[index]["lr"]
        return brought if isinstance(brought, Tensor) else rate

    @torch.no_grad()
    def step(self, finite: bool | Tensor = True) -> None:
        """Update every parameter that has a gradient.

        The state of a parameter with a changed shape starts from zero.

        Args:
            finite: whether the step's loss and gradients are finite; () bool if still on the device. If False, the step
                changes nothing.
        """
        found_inf = (~finite).float() if isinstance(finite, Tensor) else None
        for index, group in enumerate(self.param_groups):
            for parameter in group["params"]:
                if self.state[parameter]["exp_avg"].shape != parameter.shape:
                    self._begin(parameter, group["sparse"])
            if group["sparse"]:
                for parameter in group["params"]:
                    self._step_sparse(parameter, index, found_inf)
            else:
                self._step_dense(index, found_inf)

    @torch.no_grad()
    def change_rows(self, change: RowChange) -> None:
        """Replace rows of a parameter and of its state; the state of fresh rows is zero.

        Args:
            change: the parameter, its kept rows, the new rows, and their order.

        Raises:
            ValueError: if this optimiser does not hold the parameter.
        """
        parameter = change.parameter
        if parameter not in self.state:
            raise ValueError("change_rows: the optimiser does not hold this parameter")
        state = self.state[parameter]
        tables = self._tables("seen" in state)
        parameter.data = tables.changed(parameter.data, change, change.fresh)
        parameter.grad = None
        for name in ("exp_avg", "exp_avg_sq", "seen"):
            if name in state:
                state[name] = tables.changed(state[name], change, None)

    def _step_sparse(self, parameter: Tensor, index: int, found_inf: Tensor | None) -> None:
        group, state, deferred = self.param_groups[index], self.state[parameter], self.deferred.get(parameter)
        moments = state["exp_avg"], state["exp_avg_sq"], state["seen"]
        betas, eps = group["betas"], group["eps"]
        updated: int | Tensor = 0
        if deferred is not None and deferred.pending and parameter.grad is None:
            updated = deferred.adam(parameter, *moments, group["lr"], betas, eps)
        elif self.has_gradient(parameter) and parameter.numel():  # a table may have no columns
            rate, gradient = self._rate(index, parameter.device), self.gradient(parameter)
            updated = sparse_adam(parameter, gradient, *moments, rate, betas, eps, found_inf)
        self._count(updated, len(parameter))

    def _count(self, updated: int | Tensor, there: int) -> None:
        if isinstance(updated, Tensor):  # in place, so that a replayed step counts too
            self._entries_on_device[0].add_(updated)
            self._entries_on_device[1].add_(there)
        else:
            self._entries = [self._entries[0] + updated, self._entries[1] + there]

    def _step_dense(self, index: int, found_inf: Tensor | None) -> None:
        group = self.param_groups[index]
        with_grad = [p for p in group["params"] if p.grad is not None]
        if not with_grad:
            return
        grads = [p.grad for p in with_grad]
        states = [self.state[p] for p in with_grad]
        means, squares = [s["exp_avg"] for s in states], [s["exp_avg_sq"] for s in states]
        steps = [s["step"] for s in states]
        rate = self._rate(index, with_grad[0].device)
        dense_adam(with_grad, grads, means, squares, steps, rate, group["betas"], group["eps"], found_inf)


def make_optimizer(model: Model[Any], config: TrainConfig) -> Adam:
    """Return Adam over the model's parameter groups, each with its initial learning rate as `initial_lr`.

    Args:
        model: the model; `Model.groups` gives the parameter groups.
        config: the run's settings, which are the groups' defaults.

    Raises:
        ConfigError: if the parameters and Adam's state need more memory than the machine has. Tables in files do not
            count.
    """
    groups = [_plain(group, config) for group in model.groups()]
    tables = [parameter for group in model.groups() if group.settings.sparse for parameter in group.parameters]
    in_files = sum(table.numel() for table in tables) if model.tables.in_files else 0
    require(3.0 * 4 * (model.size() - in_files), "the model's parameters and Adam's state")
    deferred = {module.table: module.deferred for module in parts(model, DefersGradient) if module.deferred is not None}
    betas = (config.adam_beta1, config.adam_beta2)
    return Adam(groups, deferred, config.learning_rate, betas, config.adam_eps, model.tables)


def _plain(group: ParameterGroup, config: TrainConfig) -> dict[str, Any]:
    """Return a group in the form of PyTorch's optimisers."""
    settings = group.settings
    rate = config.learning_rate if settings.learning_rate is None else settings.learning_rate
    plain: dict[str, Any] = {"params": list(group.parameters), "name": settings.name, "lr": rate, "initial_lr": rate}
    names = "betas", "eps", "schedule", "warmup_steps", "sparse"
    named = {name: getattr(settings, name) for name in names}
    return plain | {name: value for name, value in named.items() if value is not None}


def learning_rate_factor(
    config: TrainConfig, step: int, progress: float, schedule: str | None = None, warmup_steps: int | None = None
) -> float:
    """Return the learning rate as a fraction of the initial one.

    Args:
        config: the run's settings: schedule, final fraction and warm-up steps.
        step: number of training steps done.
        progress: fraction of the budget spent, clamped to [0, 1].
        schedule: a group's own schedule; None for the run's.
        warmup_steps: a group's own number of warm-up steps; None for the run's.
    """
    progress = min(max(progress, 0.0), 1.0)
    steps = config.lr_warmup_steps if warmup_steps is None else warmup_steps
    warm_up = min(1.0, (step + 1) / steps) if steps else 1.0
    return warm_up * _decay(schedule or config.lr_schedule, config.lr_final, progress)


def _decay(schedule: str, final: float, progress: float) -> float:
    if schedule == "constant":
        return 1.0
    if schedule == "exponential":
        return float(final**progress)
    if schedule == "hold-exponential":
        return float(final ** max(0.0, 2 * progress - 1))
    if schedule == "fall-late":
        return float(final ** max(0.0, (progress - LATE) / (1 - LATE)))
    return final + (1 - final) * 0.5 * (1 + float(torch.tensor(progress * torch.pi).cos()))


def set_learning_rate(optimizer: Adam, config: TrainConfig, step: int, progress: float) -> None:
    """Set each group's learning rate for a step, from the run's schedule and warm-up or the group's own.

    Args:
        optimizer: the optimiser; each group has its initial learning rate as `initial_lr`.
        step: number of training steps done.
        progress: fraction of the budget spent, 0 to 1.
    """
    for group in optimizer.param_groups:
        own = group.get("schedule"), group.get("warmup_steps")
        group["lr"] = group["initial_lr"] * learning_rate_factor(config, step, progress, *own)
    optimizer.bring_rates()


def first_non_finite(model: Model, optimizer: Adam) -> str | None:
    """Return the name of the first parameter with non-finite values or gradients; None if there is none.

    Args:
        optimizer: the optimiser of its parameters.

    Returns:
        The parameter's name, with ".grad" if its gradient is not finite.
    """
    bad = optimizer.first_bad()
    for name, parameter in model.named_parameters():
        if not all_finite([parameter.detach()]):
            return name
        if parameter is bad:
            return f"{name}.grad"
    return None
