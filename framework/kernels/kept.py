"""Results of operations that are kept from a pass without gradient for the one that needs it.

A sampler that marches in waves needs densities before it knows which samples it keeps. `Waves` evaluates a function
wave by wave, noting on a tape what each operation of ours returned, and once more, with gradient, for the samples that
were chosen: there every operation takes its rows from the tapes, so that only the backward pass is left to compute.
The function is written as if nothing of this existed.

A result is taken only where the same operation was called with the same parameters on the same rows, which is checked
value by value; everything else is computed again. So a function may do anything, such as evaluate in chunks or sort its
positions: one that is unusual loses the saving and nothing else.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import torch
from torch import Tensor

from framework.kernels.rows import gather_rows, take_rows

CLOSE, ALMOST_ZERO = 1e-4, 1e-6
"""Relative and absolute difference of equal inputs: torch rounds differently in batches of different sizes."""
Compute = Callable[[], Tensor]
Key = tuple[Any, ...]


class _Value(NamedTuple):
    """A tensor as it was when it was noted."""

    tensor: Tensor
    version: int

    @classmethod
    def of(cls, tensor: Tensor) -> _Value:
        # Shares memory and version, and holds no graph. Most have none: a detach each would be felt in a short step.
        return cls(tensor.detach() if tensor.requires_grad else tensor, tensor._version)

    @property
    def unchanged(self) -> bool:
        """Whether nobody has written to it since."""
        return self.tensor._version == self.version

    def is_(self, other: Tensor) -> bool:
        """Whether `other` is the same memory, unchanged. While held here, it cannot have become another tensor's."""
        mine = self.tensor
        return mine.data_ptr() == other.data_ptr() and mine.shape == other.shape and self.version == other._version


class _Call(NamedTuple):
    """A call of an operation on one wave."""

    key: Key
    """Its name, its settings, its inputs' shapes, and which of them are results of earlier calls."""
    parameters: tuple[_Value, ...]
    inputs: tuple[_Value, ...]
    """Those that are no results of earlier calls."""
    result: _Value

    def stands_for(self, key: Key, parameters: Sequence[Tensor]) -> bool:
        """Whether another call is of the same operation, parameters and sources, so that only inputs may differ."""
        return (
            self.key == key
            and len(self.parameters) == len(parameters)
            and all(value.is_(parameter) for value, parameter in zip(self.parameters, parameters, strict=True))
            and all(value.unchanged for value in (self.result, *self.inputs))
        )


class _Tape:
    """The calls on one wave of `count` samples that returned a row for each of them."""

    def __init__(self, count: int) -> None:
        self.count = count
        self.calls: list[_Call] = []

    def result(self, key: Key, rows: Sequence[Tensor], parameters: Sequence[Tensor], compute: Compute) -> Tensor:
        """Compute it, and note it."""
        out = compute()
        if out.shape[0] == self.count > 0:
            sources = _sources(rows, [call.result for call in self.calls])
            inputs = tuple(_Value.of(row) for row, source in zip(rows, sources, strict=True) if source is None)
            values = tuple(_Value.of(parameter) for parameter in parameters)
            self.calls.append(_Call((key, sources), values, inputs, _Value.of(out)))
        return out


class _Replay:
    """The chosen rows, in `order`, of the results on the tapes, handed out call by call."""

    def __init__(self, tapes: Sequence[_Tape], order: Tensor) -> None:
        noted = [tape.calls for tape in tapes if tape.count]
        alike = len({len(calls) for calls in noted}) == 1
        self.calls = list(zip(*noted, strict=True)) if alike else []
        self.order = order
        self.next = 0
        self.taken: list[_Value | None] = [None] * len(self.calls)

    def result(self, key: Key, rows: Sequence[Tensor], parameters: Sequence[Tensor], compute: Compute) -> Tensor:
        """The rows of the next call on the tapes that this one repeats; computed where there is none."""
        if rows[0].shape[0] == self.order.shape[0] > 0:
            sources = _sources(rows, self.taken)
            for number in range(self.next, len(self.calls)):
                waves = self.calls[number]
                if all(call.stands_for((key, sources), parameters) for call in waves):
                    self.next = number + 1
                    found = self._take(number, [r for r, s in zip(rows, sources, strict=True) if s is None])
                    return compute() if found is None else found
        return compute()

    def _take(self, number: int, inputs: Sequence[Tensor]) -> Tensor | None:
        """A call's rows; None where its inputs were not these."""
        waves = self.calls[number]
        columns = [[call.inputs[index].tensor for call in waves] for index in range(len(inputs))]
        out, *before = gather_rows([[call.result.tensor for call in waves], *columns], self.order)
        if not all(_equal(one, other) for one, other in zip(inputs, before, strict=True)):
            return None
        self.taken[number] = _Value.of(out)
        return out


def _sources(rows: Sequence[Tensor], results: Sequence[_Value | None]) -> tuple[int | None, ...]:
    """Of each input the number of the call whose result it is; None where it is no such result."""
    return tuple(
        next((number for number, value in enumerate(results) if value is not None and value.is_(row)), None)
        for row in rows
    )


def _equal(one: Tensor, other: Tensor) -> bool:
    """Whether two tensors of the same shape are equal but for rounding; NaN equals NaN."""
    return torch.equal(one, other) or torch.allclose(one, other, CLOSE, ALMOST_ZERO, equal_nan=True)


class _Thread(threading.local):
    """What this thread's operations note their results on, or take them from."""

    tape: _Tape | _Replay | None = None


_thread = _Thread()


@contextmanager
def _used(tape: _Tape | _Replay) -> Iterator[None]:
    before, _thread.tape = _thread.tape, tape
    try:
        yield
    finally:
        _thread.tape = before


def result(key: Key, rows: Sequence[Tensor], parameters: Sequence[Tensor], compute: Compute) -> Tensor:
    """What a compiled operation returns: computed, or taken from what was computed before.

    To be called within an operation's `torch.autograd.Function.forward`, whose backward pass must not depend on which
    of the two it was.

    Args:
        key: the operation's name, and all settings that its result depends on.
        rows: its inputs (N, ...) that have a row for each sample.
        parameters: its other inputs.
        compute: computes the result (N, ...), row i from row i of the inputs alone.
    """
    tape = _thread.tape
    if tape is None:
        return compute()
    shapes = tuple((row.shape[1:], row.dtype) for row in rows)
    return tape.result((key, shapes), rows, parameters, compute)


class Waves:
    """A differentiable function of samples that come in waves, of which some are chosen in the end.

    Where nobody asks for gradients, or where the function calls no operation of ours that has parameters and is
    compiled, each wave is evaluated as usual, and the chosen rows of its values are returned.
    """

    def __init__(self) -> None:
        self._follows = torch.is_grad_enabled()
        self._tapes: list[_Tape] = []
        self._values: list[tuple[Tensor, ...]] = []

    def evaluate(self, count: int, function: Callable[[], tuple[Tensor, ...]]) -> tuple[Tensor, ...]:
        """Evaluate the next wave.

        Args:
            count: N, its samples.
            function: computes its values, each of N rows.
        Returns: the values, whose gradients are not to be used.
        """
        if self._values or not self._follows:
            self._values.append(function())
            return self._values[-1]
        tape = _Tape(count)
        with _used(tape), torch.set_grad_enabled(not self._tapes):  # the first wave tells which of the two ways it is
            values = function()
        if self._tapes or any(call.parameters for call in tape.calls):
            self._tapes.append(tape)
        else:
            self._values.append(values)
        return values

    def choose(self, order: Tensor, function: Callable[[], tuple[Tensor, ...]]) -> tuple[Tensor, ...]:
        """The values of some samples, with gradient.

        Args:
            order: (M,) int64 which of the samples of all waves, each at most once.
            function: computes their values from the inputs of `evaluate`, in this order. It is called where results
                were kept.
        Returns: the values, each of M rows.
        """
        if not self._tapes:
            return tuple(take_rows(torch.cat(column), order) for column in zip(*self._values, strict=True))
        with _used(_Replay(self._tapes, order)):
            return function()
