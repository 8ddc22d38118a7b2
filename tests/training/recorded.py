"""CUDA graphs in the place of a GPU: operations that are noted as they reach torch's dispatcher, and run again.

As in a graph, the repeated operations use the tensors and Python numbers of the recorded ones, and fresh random
numbers; recording itself changes nothing. An operation that waits for the GPU cannot be recorded.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_map_only

from benchmarks.operations import _place, _tensors, _waits

T = TypeVar("T")


class Tape(TorchDispatchMode):
    """Operations in their order."""

    def __init__(self) -> None:
        super().__init__()
        self.operations: list[tuple[Any, tuple[Any, ...], dict[str, Any], Any]] = []
        """Functions, arguments and results, by their memory: a graph of autograd's is not kept."""
        self.own: set[int] = set()
        """Memory that operations on the tape have made."""
        self.before: dict[int, tuple[Tensor, Tensor]] = {}
        """Other memory that they have written to, and its earlier content."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if _place() is None:  # checks that are made on the CPU alone
            return func(*args, **kwargs)
        if _waits(func, args, kwargs):
            raise RuntimeError(f"{func} waits for the device, in {_place()}")
        if func._schema.is_mutable:
            for tensor in _written(func, args, kwargs):
                if memory(tensor) not in self.own:
                    self.before.setdefault(id(tensor), (tensor, tensor.detach().clone()))
        out = func(*args, **kwargs)
        if not func.is_view:
            self.own |= {memory(tensor) for tensor in _tensors([out])} if not func._schema.is_mutable else set()
            self.operations.append((func, *tree_map_only(Tensor, Tensor.detach, (args, kwargs, out))))
        return out

    def undo(self) -> None:
        """Undo the writes."""
        for tensor, value in reversed(self.before.values()):
            tensor.copy_(value)

    def play(self) -> None:
        """Run the operations again, with their results where they were."""
        for func, args, kwargs, out in self.operations:
            again = func(*args, **kwargs)
            if not func._schema.is_mutable:
                for tensor, value in zip(_tensors([out]), _tensors([again]), strict=True):
                    if tensor.untyped_storage().data_ptr() != value.untyped_storage().data_ptr():
                        tensor.copy_(value)


def memory(tensor: Tensor) -> int:
    return tensor.untyped_storage()._cdata


def _written(func: Any, args: Any, kwargs: Any) -> list[Tensor]:
    """Tensors that an operation writes to."""
    found = []
    for number, argument in enumerate(func._schema.arguments):
        if argument.alias_info is not None and argument.alias_info.is_write:
            found += _tensors([args[number] if number < len(args) else kwargs.get(argument.name)])
    return found


class FakeRecorder:
    """Records on the CPU."""

    def __init__(self) -> None:
        self.tapes: list[Tape] = []
        self.repeated = 0

    def run(self, function: Callable[[], T]) -> T:
        return function()

    def watched(self, function: Callable[[], T]) -> tuple[T, str | None]:
        return function(), None

    @torch.no_grad()
    def _play(self, tape: Tape) -> None:
        self.repeated += 1
        tape.play()

    def record(self, function: Callable[[], T]) -> tuple[T, Callable[[], None]]:
        tape = Tape()
        try:
            with tape:
                result = function()
        finally:
            with torch.no_grad():
                tape.undo()
        self.tapes.append(tape)
        return result, lambda: self._play(tape)


def ahead(monkeypatch: Any) -> None:
    """Let the CPU be a device that runs ahead of Python and has no kernels of ours."""
    from nerfloom.kernels import native

    monkeypatch.setattr(native, "available", lambda: False)
    monkeypatch.setattr(native, "has", lambda name: False)
    monkeypatch.setattr("nerfloom.base.device.runs_ahead", lambda device: True)
    monkeypatch.setattr("nerfloom.training.step.is_bad_here", lambda loss: False)
