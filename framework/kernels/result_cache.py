"""Cache of operations' results between a pass without gradient and a later one with gradient.

A sampler that marches in waves needs densities before it knows which samples it keeps. `Waves` evaluates a function
wave by wave and records the results of compiled operations on a tape. It then evaluates the function again, with
gradient, for the kept samples. This time the operations take their results from the tapes, so that only the backward
pass is computed. The function itself needs no changes.

A result is reused only if the same operation was called with the same parameters on the same rows, compared by value;
everything else is recomputed. So a function that evaluates in chunks or sorts its positions is still computed
correctly, without the saving.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import torch
from torch import Tensor

from nerfloom.kernels.rows import gather_rows, joined, take_rows

TOLERANCES = 1e-4, 1e-6
"""Relative and absolute tolerance of equal inputs, since torch's rounding depends on the batch size."""
Compute = Callable[[], Tensor]
Key = tuple[Any, ...]


class _Value(NamedTuple):
    """A tensor and its version when recorded."""

    tensor: Tensor
    version: int

    @classmethod
    def of(cls, tensor: Tensor) -> _Value:
        # Shares memory and version, and holds no graph. Most have none; a detach for each would slow down short steps.
        return cls(tensor.detach() if tensor.requires_grad else tensor, tensor._version)

    @property
    def unchanged(self) -> bool:
        """Whether the tensor has not been modified since."""
        return self.tensor._version == self.version

    def is_(self, other: Tensor) -> bool:
        """Return whether `other` is the same unmodified memory; memory held here cannot be reused."""
        tensor = self.tensor
        return tensor.data_ptr() == other.data_ptr() and tensor.shape == other.shape and self.version == other._version

    def equals(self, other: Tensor) -> bool:
        """Return whether `other` is the same memory or has the same values, as weights that each call computes."""
        if self.is_(other):
            return True
        tensor = self.tensor
        alike = tensor.shape == other.shape and tensor.dtype == other.dtype and tensor.device == other.device
        return alike and self.unchanged and torch.equal(tensor, other)


class _Call(NamedTuple):
    """A call of an operation on one wave."""

    key: Key
    """Name and settings of the operation, shapes of its inputs, and the earlier calls that computed them."""
    parameters: tuple[_Value, ...]
    inputs: tuple[_Value, ...]
    """The inputs that are not results of earlier calls."""
    result: _Value

    def stands_for(self, key: Key, parameters: Sequence[Tensor]) -> bool:
        """Return whether a call has the same operation, parameters and sources, so that only inputs may differ."""
        return (
            self.key == key
            and len(self.parameters) == len(parameters)
            and all(value.equals(parameter) for value, parameter in zip(self.parameters, parameters, strict=True))
            and all(value.unchanged for value in (self.result, *self.inputs))
        )


class _Tape:
    """The recorded calls on one wave of `count` samples; only calls that return one row per sample are recorded."""

    def __init__(self, count: int) -> None:
        self.count = count
        self.calls: list[_Call] = []

    def result(self, key: Key, rows: Sequence[Tensor], parameters: Sequence[Tensor], compute: Compute) -> Tensor:
        """Compute the result and record it."""
        out = compute()
        if out.shape[0] == self.count > 0:
            sources = _sources(rows, [call.result for call in self.calls])
            inputs = tuple(_Value.of(row) for row, source in zip(rows, sources, strict=True) if source is None)
            values = tuple(_Value.of(parameter) for parameter in parameters)
            self.calls.append(_Call((key, sources), values, inputs, _Value.of(out)))
        return out


class _Replay:
    """Rows, in `order`, of the results on the tapes, returned call by call."""

    def __init__(self, tapes: Sequence[_Tape], order: Tensor) -> None:
        recorded = [tape.calls for tape in tapes if tape.count]
        alike = len({len(calls) for calls in recorded}) == 1
        self.calls = list(zip(*recorded, strict=True)) if alike else []
        self.order = order
        self.next = 0
        self.results: list[_Value | None] = [None] * len(self.calls)

    def result(self, key: Key, rows: Sequence[Tensor], parameters: Sequence[Tensor], compute: Compute) -> Tensor:
        """Return the rows of the next recorded call that matches this one; compute them if there is none."""
        if rows[0].shape[0] == self.order.shape[0] > 0:
            sources = _sources(rows, self.results)
            for number in range(self.next, len(self.calls)):
                waves = self.calls[number]
                if all(call.stands_for((key, sources), parameters) for call in waves):
                    self.next = number + 1
                    gathered = self._take(number, [r for r, s in zip(rows, sources, strict=True) if s is None])
                    return compute() if gathered is None else gathered
        return compute()

    def _take(self, number: int, inputs: Sequence[Tensor]) -> Tensor | None:
        """Return the rows of a recorded call's result; None if its inputs were different."""
        waves = self.calls[number]
        columns = [[call.inputs[index].tensor for call in waves] for index in range(len(inputs))]
        out, *recorded = gather_rows([[call.result.tensor for call in waves], *columns], self.order)
        if not all(_equal(tensor, other) for tensor, other in zip(inputs, recorded, strict=True)):
            return None
        self.results[number] = _Value.of(out)
        return out


class _Given:
    """Known results by name of the operation; each is taken once."""

    def __init__(self, results: dict[str, Tensor]) -> None:
        self.results = results

    def result(self, key: Key, rows: Sequence[Tensor], parameters: Sequence[Tensor], compute: Compute) -> Tensor:
        """Return the known result of the operation, or compute it."""
        found = self.results.pop(key[0][0], None)
        return compute() if found is None else found


def _sources(rows: Sequence[Tensor], results: Sequence[_Value | None]) -> tuple[int | None, ...]:
    """Return, for each input, the index of the call that computed it, or None."""
    return tuple(
        next((number for number, value in enumerate(results) if value is not None and value.is_(row)), None)
        for row in rows
    )


def _equal(tensor: Tensor, other: Tensor) -> bool:
    """Return whether two tensors of the same shape are equal up to rounding errors; NaN equals NaN."""
    return torch.equal(tensor, other) or torch.allclose(tensor, other, *TOLERANCES, equal_nan=True)


class _Thread(threading.local):
    """The tape where operations of this thread record results, or find them."""

    tape: _Tape | _Replay | _Given | None = None


_thread = _Thread()


@contextmanager
def _used(tape: _Tape | _Replay | _Given) -> Iterator[None]:
    previous, _thread.tape = _thread.tape, tape
    try:
        yield
    finally:
        _thread.tape = previous


@contextmanager
def given(**results: Tensor) -> Iterator[None]:
    """Make operations return results that another kernel has computed, within a `with` block.

    Args:
        results: result of the first call of each operation, by its name.
    """
    with _used(_Given(results)):
        yield


def result(key: Key, rows: Sequence[Tensor], parameters: Sequence[Tensor], compute: Compute) -> Tensor:
    """Return the result of a compiled operation, computed or taken from a recorded call.

    Call it in `forward` of the operation's `torch.autograd.Function`; the backward pass must not depend on whether the
    result was computed or taken.

    Args:
        key: name of the operation, and all settings that its result depends on.
        rows: inputs (N, ...) of the operation with one row per sample.
        parameters: other inputs of the operation.
        compute: computes the result (N, ...); its row i must depend only on row i of the inputs.

    Returns:
        (N, ...) result.
    """
    tape = _thread.tape
    if tape is None:
        return compute()
    shapes = tuple((row.shape[1:], row.dtype) for row in rows)
    return tape.result((key, shapes), rows, parameters, compute)


class Waves:
    """Evaluation of a differentiable function of samples in waves; some of the samples are kept.

    If gradients are disabled, or if the function calls no compiled operation with parameters, each wave is evaluated as
    usual, and the kept rows of its values are returned.
    """

    def __init__(self) -> None:
        self._follows = torch.is_grad_enabled()
        self._tapes: list[_Tape] = []
        self._values: list[tuple[Tensor, ...]] = []

    def evaluate(self, count: int, function: Callable[[], tuple[Tensor, ...]]) -> tuple[Tensor, ...]:
        """Evaluate the next wave.

        Args:
            count: number N of samples of the wave.
            function: computes the values of the wave, each with N rows.

        Returns:
            The values; their gradients must not be used.
        """
        if self._values or not self._follows:
            self._values.append(function())
            return self._values[-1]
        tape = _Tape(count)
        with _used(tape), torch.set_grad_enabled(not self._tapes):  # the first wave shows if there are parameters
            values = function()
        if self._tapes or any(call.parameters for call in tape.calls):
            self._tapes.append(tape)
        else:
            self._values.append(values)
        return values

    def choose(self, order: Tensor, function: Callable[[], tuple[Tensor, ...]]) -> tuple[Tensor, ...]:
        """Return the values of some samples, with gradient.

        Args:
            order: (M,) int64 indices of the samples, counted over all waves, each at most once.
            function: computes the values of these samples, in this order, from the same inputs as in `evaluate`. It is
                called only if results were recorded.

        Returns:
            The values, each with M rows.
        """
        columns = list(zip(*self._values, strict=True))
        if columns and not self._follows:
            return tuple(gather_rows(columns, order))
        if not self._tapes:
            return tuple(take_rows(joined(column), order) for column in columns)
        with _used(_Replay(self._tapes, order)):
            return function()
