"""Optimiser settings that modules declare for their parameters."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Protocol, runtime_checkable

from nerfloom.base.protocols import SeesRegistered

if TYPE_CHECKING:
    from torch import Tensor, nn

Schedule = Literal["constant", "exponential", "cosine", "hold-exponential", "fall-late"]


@dataclass(frozen=True)
class Optimised:
    """Optimiser settings of a module's parameters. None takes the value of the containing module, or of the run.

    A module declares them in its attribute `optimised`. They apply to the module's parameters and to submodules without
    settings of their own.
    """

    name: str | None = None
    """Name of the group in logs of the learning rate."""
    learning_rate: float | None = None
    """Initial learning rate of Adam."""
    betas: tuple[float, float] | None = None
    """Decay rates of Adam's first and second moments."""
    eps: float | None = None
    """Epsilon of Adam."""
    schedule: Schedule | None = None
    """Schedule of the learning rate over the training budget."""
    warmup_steps: int | None = None
    """Number of steps over which the learning rate rises linearly from 0."""
    sparse: bool | None = None
    """True if the parameters are tables (E, F) and a step updates only the entries that it used."""

    def within(self, outer: Optimised) -> Optimised:
        """Return these settings, with values of None replaced by the values of `outer`."""
        own = {name: value for name, value in vars(self).items() if value is not None}
        return dataclasses.replace(outer, **own)


@dataclass(frozen=True)
class ParameterGroup:
    """Parameters with the same optimiser settings."""

    parameters: tuple[nn.Parameter, ...]
    """The parameters. Each parameter of a model is in exactly one group."""
    settings: Optimised
    """Their optimiser settings."""


@dataclass(frozen=True)
class RowChange:
    """A change of a parameter's rows: keeps some, in any order, and adds new ones.

    Kept rows keep their optimiser state; new rows start with a fresh one.
    """

    parameter: nn.Parameter
    """(E, ...) a parameter of the model."""
    kept: Tensor
    """(K,) int64 indices of the kept rows, in their new order."""
    fresh: Tensor | None = None
    """(A, ...) values of the new rows; None if there are none."""
    order: Tensor | None = None
    """(K + A,) int64 order of the kept and then the new rows; None to leave the new rows at the end."""


@runtime_checkable
class DefersGradient(Protocol, metaclass=SeesRegistered):
    """A module with a table; the optimiser accumulates its gradient instead of autograd."""

    table: nn.Parameter
    """(E, F) the table."""
    deferred: Any
    """The `DeferredGradient` (kernels/adam/deferred.py); None if autograd accumulates it."""


def parameter_groups(model: nn.Module) -> list[ParameterGroup]:
    """Return the parameters of `model`, grouped by the `Optimised` settings that its modules declare."""
    groups: dict[Optimised, list[nn.Parameter]] = {}
    grouped: set[int] = set()

    def visit(module: nn.Module, outer: Optimised) -> None:
        own = getattr(module, "optimised", None)
        settings = outer if own is None else own.within(outer)
        for parameter in module.parameters(recurse=False):
            if id(parameter) not in grouped:
                grouped.add(id(parameter))
                groups.setdefault(settings, []).append(parameter)
        for child in module.children():
            visit(child, settings)

    visit(model, Optimised(name="networks", sparse=False))
    return [ParameterGroup(tuple(parameters), settings) for settings, parameters in groups.items()]
