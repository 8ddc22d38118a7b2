"""How the parameters of a module are to be optimised, said by the module itself."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Protocol, runtime_checkable

if TYPE_CHECKING:
    from torch import Tensor, nn

Schedule = Literal["constant", "exponential", "cosine", "hold-exponential"]


@dataclass(frozen=True)
class Optimised:
    """How a module's parameters are optimised. What is None is as for the module that holds it, or as the run says.

    A module has it as its attribute `optimised`; it counts for the parameters of all modules within that have none.
    """

    name: str | None = None
    """What the learning rate's curve is called."""
    learning_rate: float | None = None
    """Adam's learning rate at the start."""
    betas: tuple[float, float] | None = None
    """Adam's decay of the mean and of the squared gradient."""
    eps: float | None = None
    """Adam's epsilon."""
    schedule: Schedule | None = None
    """Learning rate over the budget."""
    sparse: bool | None = None
    """The parameters are tables (E, F), of which a step updates only the entries that it used."""

    def within(self, outer: Optimised) -> Optimised:
        """Return these settings with what is open as in `outer`."""
        own = {name: value for name, value in vars(self).items() if value is not None}
        return dataclasses.replace(outer, **own)


@dataclass(frozen=True)
class ParameterGroup:
    """Parameters that are optimised alike."""

    parameters: tuple[nn.Parameter, ...]
    """The parameters, each of which is in one group."""
    settings: Optimised
    """How they are optimised."""


@dataclass(frozen=True)
class RowChange:
    """New rows for a parameter: some of the old ones in another order, and fresh ones behind them.

    The optimiser's state of a row goes with it; that of a fresh row begins anew.
    """

    parameter: nn.Parameter
    """(E, ...) a parameter of the model."""
    kept: Tensor
    """(K,) int64, which rows stay, in their new order."""
    fresh: Tensor | None = None
    """(A, ...) further rows; None for none."""


@runtime_checkable
class DefersGradient(Protocol):
    """A table whose gradient waits for the optimiser instead of being added up by autograd."""

    table: nn.Parameter
    """(E, F)."""
    deferred: Any
    """The waiting gradient (`framework.kernels`); None where autograd adds it up after all."""


def parameter_groups(model: nn.Module) -> list[ParameterGroup]:
    """Return the parameters of a model, grouped by how its modules say that they are optimised.

    Args:
        model: a module, whose own `optimised` counts for all.
    """
    groups: dict[Optimised, list[nn.Parameter]] = {}
    taken: set[int] = set()

    def visit(module: nn.Module, outer: Optimised) -> None:
        own = getattr(module, "optimised", None)
        settings = outer if own is None else own.within(outer)
        for parameter in module.parameters(recurse=False):
            if id(parameter) not in taken:
                taken.add(id(parameter))
                groups.setdefault(settings, []).append(parameter)
        for child in module.children():
            visit(child, settings)

    visit(model, Optimised(name="networks", sparse=False))
    return [ParameterGroup(tuple(parameters), settings) for settings, parameters in groups.items()]
