"""Which implementation of an operation runs: one table, asked once a call.

An operation has a reference, which is torch on any device, in any type and of any derivative, and implementations by
backends for some of that. A new backend adds an implementation to each operation it has; what calls the operation stays
as it is.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, Generic, ParamSpec, TypeVar

import torch
from torch import Tensor

from framework.kernels import native

P = ParamSpec("P")
R = TypeVar("R")


@dataclass(frozen=True)
class Backend:
    """Where implementations run."""

    name: str
    reads: Callable[[Tensor], bool]
    """Whether it can read a tensor's memory. Not by the device's name, which torch takes a microsecond to tell."""
    available: Callable[[], bool]
    """Whether it can be used on this machine."""


REFERENCE = Backend("reference", lambda tensor: True, lambda: True)
TORCH = Backend("torch", lambda tensor: True, lambda: True)
"""torch's own fast implementation, where it has one that is not the readable reference."""
CPP = Backend("c++", attrgetter("is_cpu"), lambda: native.available())
FLOAT32, INT64, BOOL = (frozenset({kind}) for kind in (torch.float32, torch.int64, torch.bool))


@dataclass(frozen=True)
class Implementation(Generic[P, R]):
    """One way to compute an operation, and when it may be taken."""

    backend: Backend
    run: Callable[P, R]
    types: frozenset[torch.dtype] | None = None
    """Of the tensors that are looked at; None for all."""
    order: float = torch.inf
    """Of the highest derivative that it has: 0 for none."""
    differentiable: int | None = None
    """How many of the tensors, the first ones, it has derivatives for; None for all."""
    fits: Callable[P, bool] | None = None
    """A further condition on the arguments."""

    def suits(self, tensors: Sequence[Tensor | None], *args: P.args, **kwargs: P.kwargs) -> bool:
        """Whether it may be taken for these tensors and arguments."""
        reads, types = self.backend.reads, self.types
        for tensor in tensors:
            if tensor is not None and not (reads(tensor) and (types is None or tensor.dtype in types)):
                return False
        first = 0 if _thread.order > self.order else self.differentiable
        if first is not None and torch.is_grad_enabled():
            for tensor in tensors[first:]:
                if tensor is not None and tensor.requires_grad:
                    return False
        return self.backend.available() and (self.fits is None or self.fits(*args, **kwargs))


class Operation(Generic[P, R]):
    """A row of the table: an operation's reference and its other implementations.

    Args:
        name: under which it is listed.
        reference: the readable form in torch, which is taken where nothing else is.
    """

    def __init__(self, name: str, reference: Callable[P, R]) -> None:
        self.name = name
        self.reference = Implementation(REFERENCE, reference)
        self.implementations: list[Implementation[P, R]] = []
        """Beside the reference, the preferred ones first."""
        _operations[name] = self

    def implementation(
        self,
        backend: Backend,
        types: frozenset[torch.dtype] | None = FLOAT32,
        order: float = 1,
        differentiable: int | None = None,
        fits: Callable[P, bool] | None = None,
    ) -> Callable[[Callable[P, R]], Callable[P, R]]:
        """A decorator that adds a function as the implementation by a backend.

        Args:
            backend: where it runs.
            types: of the tensors that are looked at; None for all.
            order: of the highest derivative that it has: 0 for none.
            differentiable: how many of the tensors, the first ones, it has derivatives for; None for all.
            fits: a further condition on the arguments.
        """

        def add(run: Callable[P, R]) -> Callable[P, R]:
            self.implementations.append(Implementation(backend, run, types, order, differentiable, fits))
            return run

        return add

    def choose(self, tensors: Sequence[Tensor | None], *args: P.args, **kwargs: P.kwargs) -> Implementation[P, R]:
        """The first implementation that may be taken, or the reference. Arguments as for a call."""
        for implementation in self.implementations:
            if implementation.suits(tensors, *args, **kwargs):
                return implementation
        return self.reference

    def __call__(self, tensors: Sequence[Tensor | None], *args: P.args, **kwargs: P.kwargs) -> R:
        """Run the operation.

        Args:
            tensors: those whose device, type and gradients decide which implementation runs; None is passed over.
            args, kwargs: the arguments, the same for all implementations.
        """
        return self.choose(tensors, *args, **kwargs).run(*args, **kwargs)


_operations: dict[str, Operation[..., Any]] = {}


def table() -> dict[str, tuple[str, ...]]:
    """The backends of every operation in the modules that are imported, the reference last."""
    return {
        name: tuple(one.backend.name for one in (*operation.implementations, operation.reference))
        for name, operation in sorted(_operations.items())
    }


class _Thread(threading.local):
    order = 1.0


_thread = _Thread()


@contextmanager
def derivatives(order: int) -> Iterator[None]:
    """Within it, only implementations that have derivatives of this order are taken where gradients are asked for.

    Outside it is 1. A loss on a field's gradient (an eikonal term, say) needs 2.

    Args:
        order: of the highest derivative that will be asked for.
    """
    before, _thread.order = _thread.order, order
    try:
        yield
    finally:
        _thread.order = before
