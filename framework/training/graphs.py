"""Training steps captured and replayed as CUDA graphs, so that the GPU does not wait for Python.

A step of nerfacto consists of hundreds of small operations. Launching them one by one takes longer than the GPU's work.
A CUDA graph records the launches with the addresses of their tensors, and replays all of them at once. Values that
differ between steps are in tensors at fixed addresses: parameters, Adam's state, learning rates
(`base.device.StepValue`) and images. Random numbers are a function of the generator's seed, which is the step's, and
the position of the draw (Philox; Salmon et al. 2011). A replayed step is therefore the same as an ordinary one.

Each graph is tested: in the step after its capture, the step also runs without it, and both must give the same loss and
the same update of all learnt tensors. A second test follows later, when tensors that the graph might have fixed by
mistake have changed. If anything fails, training continues without graphs, and a message says why.
"""

from __future__ import annotations

import gc
import warnings
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import torch
from torch import Tensor

from nerfloom.base.console import say
from nerfloom.base.errors import ConfigError, one_line
from nerfloom.base.processes import processes
from nerfloom.base.step_kind import StepKind
from nerfloom.data.sources import BatchSource
from nerfloom.model import Model

T = TypeVar("T")
WARM_UP = 3
"""Number of steps of a kind before one is captured. They compile kernels, set up libraries and copy constants to the
device."""
TOLERANCE = 0.1
"""Maximum difference between the updates of a tensor by a replayed and an ordinary step, relative to the latter. The
bits differ, since the order of sums on a GPU varies; a step with another draw, learning rate or number differs by its
whole size."""
LOSS_TOLERANCE = 0.01
"""Maximum difference between the losses of both, relative to the ordinary step's."""
REPLAYS_BEFORE_TESTS = 0, 64
"""Numbers of replays before each test of a graph. In 64 steps an occupancy grid has been updated at least four times,
learning rates have changed, and other tensors may have moved."""
MAX_KINDS = 4
"""Maximum number of kinds of steps with a graph in memory; the most recent are kept."""
WAITED = "called a synchronizing CUDA operation"
"""Part of torch's warning where Python waits for the GPU."""
FLAG = "--machine.cuda-graphs"


class Recorder(Protocol):
    """Captures the operations that a function launches on a device."""

    def run(self, function: Callable[[], T]) -> T:
        """Call `function` in the same way as for a capture, and return its result."""

    def watched(self, function: Callable[[], T]) -> tuple[T, str | None]:
        """Call `function` like `run`, and return its result and where it waited for the device; None if nowhere."""

    def record(self, function: Callable[[], T]) -> tuple[T, Callable[[], None]]:
        """Capture `function` without running its operations.

        Returns:
            Its result, with tensors that get their values in a replay, and the function that replays it.
        """


class CudaRecorder:
    """CUDA graphs on their own stream of a `device`; autograd's nodes must run on the stream that created them."""

    def __init__(self, device: torch.device) -> None:
        self.device, self.stream = device, torch.cuda.Stream(device)

    def run(self, function: Callable[[], T]) -> T:
        """Call `function` on the stream, and return its result."""
        self.stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(self.stream):
            result = function()
        torch.cuda.current_stream().wait_stream(self.stream)
        return result

    def watched(self, function: Callable[[], T]) -> tuple[T, str | None]:
        """Call `function` on the stream, and return its result and where it waited for the GPU; None if nowhere.

        Capturing a step that synchronises fails, and leaves torch's allocator and generator unusable. This call detects
        such a step before.
        """
        before = torch.cuda.get_sync_debug_mode()
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            torch.cuda.set_sync_debug_mode("warn")
            try:
                result = self.run(function)
            finally:
                torch.cuda.set_sync_debug_mode(before)
        places = [f"{Path(each.filename).name}:{each.lineno}" for each in warned if WAITED in str(each.message)]
        return result, places[0] if places else None

    def record(self, function: Callable[[], T]) -> tuple[T, Callable[[], None]]:
        """Capture `function` as a graph, and return its result, in the graph's memory, and the replay function.

        Raises:
            ConfigError: if that fails and leaves the GPU or its generator unusable.
        """
        graph = torch.cuda.CUDAGraph()
        gc.collect()  # as torch does up to 2.8
        collecting = gc.isenabled()
        gc.disable()  # freeing a kernel or another graph would break the capture
        try:
            with torch.cuda.graph(graph, stream=self.stream):
                result = function()
        except Exception as failure:
            try:
                torch.rand((), device=self.device)
                torch.cuda.synchronize(self.device)
            except RuntimeError:
                raise ConfigError(f"capturing a CUDA graph failed ({one_line(failure)}); use {FLAG} off") from failure
            raise
        finally:
            if collecting:
                gc.enable()
        return result, graph.replay


@dataclass
class _Kind(Generic[T]):
    """A kind of step, with its graph."""

    taken: int = 0
    """Number of warm-up steps."""
    recorded: tuple[T, Callable[[], None]] | None = None
    """The result of the captured step, and its replay function."""
    repeated: int = 0
    """Number of replays."""
    passed: int = 0
    """Number of passed tests."""


class StepGraphs(Generic[T]):
    """Steps of a run, captured and replayed by kind.

    Args:
        recorder: captures the steps.
        learnt: returns all tensors that a step changes permanently: parameters, and the optimiser's state.
        must: whether a step that cannot be captured is an error.
        loss: returns the loss () of a step's result, which is tested too; None if there is none.
    """

    def __init__(
        self,
        recorder: Recorder,
        learnt: Callable[[], Sequence[Tensor]],
        must: bool = False,
        loss: Callable[[T], Tensor] | None = None,
    ) -> None:
        self._recorder, self._learnt, self._must, self._loss = recorder, learnt, must, loss
        self.repeated = 0
        """Number of replayed steps."""
        self._kinds: dict[Hashable, _Kind[T]] = {}
        self._told: set[str] = set()
        self._given_up = self._announced = False

    def forget(self) -> None:
        """Drop all graphs, after tensors have moved."""
        self._kinds.clear()

    def take(self, kind: StepKind) -> bool:
        """Return whether to take a step of a `kind` with `run`; if not, print the reason once.

        Raises:
            ConfigError: if steps must be captured and this one cannot be.
        """
        if kind.varies is not None:
            self._refuse(kind.varies)
        return kind.varies is None and not self._given_up

    def run(self, kind: StepKind, seed: Callable[[], None], step: Callable[[], T]) -> T:
        """Take a step, by replaying a graph of the same kind if there is one.

        Args:
            kind: the step's kind.
            seed: seeds the generators for this step.
            step: takes the step; it depends only on values of tensors and on `kind`.

        Returns:
            The step's result. The next step overwrites its tensors.

        Raises:
            ConfigError: if steps must be captured and this one cannot be.
        """
        kept = self._kinds[kind.of] = self._kinds.pop(kind.of, _Kind())  # the most recent kind is the last
        if len(self._kinds) > MAX_KINDS:
            self._kinds.pop(next(iter(self._kinds)))
        if kept.recorded is None:
            seed()
            kept.taken += 1
            if kept.taken < WARM_UP:
                return self._recorder.run(step)
            result, waited = self._recorder.watched(step)
            if waited is None:
                self._record(kept, step)
            else:
                self._give_up(f"a step waits for the GPU ({waited})")
            return result
        result, repeat = kept.recorded
        if kept.passed < len(REPLAYS_BEFORE_TESTS) and kept.repeated >= REPLAYS_BEFORE_TESTS[kept.passed]:
            return self._test(kept, seed, step)
        seed()
        repeat()
        kept.repeated += 1
        self.repeated += 1
        return result

    def _record(self, kept: _Kind[T], step: Callable[[], T]) -> None:
        try:
            kept.recorded = self._recorder.record(step)
        except ConfigError:
            raise
        except Exception as error:  # torch, CUDA or Triton: each may refuse a capture
            self._give_up(f"capturing one failed ({one_line(error)})")

    def _test(self, kept: _Kind[T], seed: Callable[[], None], step: Callable[[], T]) -> T:
        """Take a step without and with its graph, and drop the graph if they differ."""
        assert kept.recorded is not None
        result, repeat = kept.recorded
        tensors = self._learnt()
        before = _copies(tensors)
        seed()
        expected = self._recorder.run(step)
        wanted = None if self._loss is None else self._loss(expected).clone()
        after = _copies(tensors)
        _restore(tensors, before)
        seed()
        repeat()
        moved = _distance(before, after)
        apart = _distance(tensors, after)
        fault = None
        if not bool((apart <= TOLERANCE * moved).all()):  # NaN is not
            fault = "make the same update as an ordinary one"
        if self._loss is not None and not _close(self._loss(result), wanted):
            fault = "have the same loss as an ordinary one"
        if fault is not None:
            _restore(tensors, after)
            self._give_up(f"a replayed step did not {fault}")
            return expected
        tells = bool((moved > 0).any())  # a dropped step proves nothing
        kept.passed += tells
        if tells and not self._announced:
            self._announced = True
            say("training steps are captured as CUDA graphs and replayed")
        return result

    def _give_up(self, why: str) -> None:
        self._given_up = True
        self._kinds.clear()
        self._refuse(why)

    def _refuse(self, why: str) -> None:
        if self._must:
            raise ConfigError(f"{FLAG} on: steps cannot be replayed as CUDA graphs, because {why}; leave it out")
        if why not in self._told:
            self._told.add(why)
            say(f"note: steps are not replayed as CUDA graphs, because {why}")


def _copies(tensors: Sequence[Tensor]) -> list[Tensor]:
    return [tensor.detach().clone() for tensor in tensors]


@torch.no_grad()
def _restore(tensors: Sequence[Tensor], values: Sequence[Tensor]) -> None:
    for tensor, value in zip(tensors, values, strict=True):
        tensor.copy_(value)


def _close(loss: Tensor, wanted: Tensor | None) -> bool:
    """Return whether two losses agree, or neither is finite."""
    assert wanted is not None
    return bool(torch.isclose(loss, wanted, LOSS_TOLERANCE, 0.0) | ~(loss.isfinite() | wanted.isfinite()))


@torch.no_grad()
def _distance(some: Sequence[Tensor], others: Sequence[Tensor]) -> Tensor:
    """Return the Euclidean distance of each pair of tensors, (K,) float64; equal infinities have distance 0."""
    pairs = zip(some, others, strict=True)
    return torch.stack([torch.where(a == b, 0.0, a.double() - b.double()).norm() for a, b in pairs])


def make_graphs(
    mode: str, device: torch.device, learnt: Callable[[], Sequence[Tensor]], loss: Callable[[Any], Tensor] | None = None
) -> StepGraphs[Any] | None:
    """Return the step graphs of a run; None if they are off or the device has none.

    Args:
        mode: auto, on or off, as configured.
        device: the device of training.
        learnt: returns all tensors that a step changes permanently.
        loss: returns the loss () of a step's result; None if there is none.

    Raises:
        ConfigError: if they are on and the device has none.
    """
    if mode == "on" and device.type != "cuda":
        raise ConfigError(f"{FLAG} on: only CUDA devices have graphs, and this run is on {device.type}; leave it out")
    if mode == "off" or device.type != "cuda":
        return None
    return StepGraphs(CudaRecorder(device), learnt, mode == "on", loss)


def kind_of_step(model: Model[Any], source: BatchSource, step: int, batch: tuple[Hashable, ...]) -> StepKind:
    """Return the kind of training step `step`, with the draw of its batch of sizes `batch` from `source`."""
    if processes().count > 1:
        return StepKind(varies="several processes exchange their gradients")
    if source.varies is not None:
        return StepKind(varies=source.varies)
    if model.resizes:
        return StepKind(varies="the number of parameters changes")
    own = model.step_kind(step)
    return StepKind((*batch, *own.of), own.varies)
