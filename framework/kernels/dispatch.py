"""Choice of the implementation of an operation, at each call, from one table.

An operation has a reference in PyTorch, for any device, type and order of derivative. Backends implement it for some of
these. A new backend adds its implementations to the operations; their callers do not change.
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

from nerfloom.kernels import native, triton_backend

P = ParamSpec("P")
R = TypeVar("R")


@dataclass(frozen=True)
class Backend:
    """A way to run operations, such as compiled C++ code."""

    name: str
    """Name in listings."""
    reads: Callable[[Tensor], bool]
    """Returns whether it can read a tensor's memory. Avoid `tensor.device`, which takes a microsecond."""
    available: Callable[[], bool]
    """Returns whether it can be used on this machine."""


REFERENCE = Backend("reference", lambda tensor: True, lambda: True)
TORCH = Backend("torch", lambda tensor: True, lambda: True)
"""Fast implementations by PyTorch itself, if they differ from the reference."""
FEW_OPERATIONS = Backend("few operations", lambda tensor: not (tensor.is_cpu and native.available()), lambda: True)
"""Implementations in PyTorch with few operations and without waiting for the device: for GPUs, and for machines without
compiled kernels. With compiled kernels the CPU takes the reference instead, so that its runs stay the same to the
bit."""
CPP = Backend("c++", attrgetter("is_cpu"), lambda: native.available())
TRITON = Backend(
    "triton", attrgetter("is_cpu" if triton_backend.INTERPRETED else "is_cuda"), lambda: triton_backend.available()
)
"""Kernels for NVIDIA's and AMD's GPUs. PyTorch calls both "cuda"."""
FLOAT32, INT64, BOOL = (frozenset({kind}) for kind in (torch.float32, torch.int64, torch.bool))


@dataclass(frozen=True)
class Implementation(Generic[P, R]):
    """An implementation of an operation, with the conditions of its use."""

    backend: Backend
    """The backend that runs it."""
    run: Callable[P, R]
    """Computes the operation."""
    types: frozenset[torch.dtype] | None = None
    """Supported types of the deciding tensors; None for all types."""
    order: float = torch.inf
    """Highest supported order of derivatives; 0 for none."""
    differentiable: int | None = None
    """Number of leading tensors with derivatives; None for all."""
    fits: Callable[P, bool] | None = None
    """Further condition on the arguments; None without."""

    def suits(self, tensors: Sequence[Tensor | None], *args: P.args, **kwargs: P.kwargs) -> bool:
        """Return whether it can be used for `tensors`, `args` and `kwargs`, which are as in `Operation`."""
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
    """An operation: its reference and its other implementations.

    Args:
        name: name in listings.
        reference: the readable form in PyTorch, used if no other implementation fits.
    """

    def __init__(self, name: str, reference: Callable[P, R]) -> None:
        self.name = name
        self.reference = Implementation(REFERENCE, reference)
        self.implementations: list[Implementation[P, R]] = []
        """Implementations other than the reference, in order of preference."""
        _operations[name] = self

    def implementation(
        self,
        backend: Backend,
        types: frozenset[torch.dtype] | None = FLOAT32,
        order: float = 1,
        differentiable: int | None = None,
        fits: Callable[P, bool] | None = None,
    ) -> Callable[[Callable[P, R]], Callable[P, R]]:
        """Return a decorator that adds a function as an implementation.

        Args:
            backend: the backend that runs it.
            types: supported types of the deciding tensors; None for all types.
            order: highest supported order of derivatives; 0 for none.
            differentiable: number of leading tensors with derivatives; None for all.
            fits: further condition on the arguments; None without.
        """

        def add(run: Callable[P, R]) -> Callable[P, R]:
            self.implementations.append(Implementation(backend, run, types, order, differentiable, fits))
            self.implementations.sort(key=lambda each: each.backend in (TORCH, FEW_OPERATIONS))  # others come first
            return run

        return add

    def choose(self, tensors: Sequence[Tensor | None], *args: P.args, **kwargs: P.kwargs) -> Implementation[P, R]:
        """Return the first implementation that can be used for `tensors`, `args` and `kwargs`, or the reference."""
        for implementation in self.implementations:
            if implementation.suits(tensors, *args, **kwargs):
                return implementation
        return self.reference

    def __call__(self, tensors: Sequence[Tensor | None], *args: P.args, **kwargs: P.kwargs) -> R:
        """Run the operation.

        Args:
            tensors: their device, type and gradients determine the implementation; None is ignored.
            args: positional arguments of the operation.
            kwargs: keyword arguments of the operation.
        """
        return self.choose(tensors, *args, **kwargs).run(*args, **kwargs)


_operations: dict[str, Operation[..., Any]] = {}


def table() -> dict[str, tuple[str, ...]]:
    """Return the names of the backends of every operation in the imported modules, the reference last."""
    return {
        name: tuple(item.backend.name for item in (*operation.implementations, operation.reference))
        for name, operation in sorted(_operations.items())
    }


class _Thread(threading.local):
    order = 1.0


_thread = _Thread()


@contextmanager
def derivatives(order: int) -> Iterator[None]:
    """Within a `with` block, use only implementations with derivatives of a given order, if gradients are needed.

    The default is 1. A loss on the gradient of a field, such as an eikonal term, needs 2.

    Args:
        order: order of the highest derivative that will be computed.
    """
    previous, _thread.order = _thread.order, order
    try:
        yield
    finally:
        _thread.order = previous
