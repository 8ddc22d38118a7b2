"""Training steps that are recorded as CUDA graphs and repeated, so that a GPU does not wait for Python.

A step of nerfacto is some hundreds of small operations; to start them one by one takes longer than the GPU computes. A
CUDA graph holds what a step has started, with the addresses of its tensors, and starts all of it again at once. What
differs between steps is in tensors that stay where they are: parameters, Adam's state, learning rates
(`base.device.StepValue`), the images; random numbers are a function of the generator's seed and the place of the draw
(Philox; Salmon et al. 2011), and the seed is that of the step. A step that was repeated is therefore the same as one
that was not.

A recording is believed only after a test: in the step after it was made, the step is also taken without it, and both
must have the same loss and change all that is learnt alike. It is tested once more later, when what a recording might
still have held on to has changed. Whatever fails, training goes on without recordings, and a line says why.
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
from nerfloom.base.errors import ConfigError
from nerfloom.base.processes import processes
from nerfloom.base.step_kind import StepKind
from nerfloom.data.sources import BatchSource
from nerfloom.model import Model

T = TypeVar("T")
WARM_UP = 3
"""Number of steps of a kind that are taken before one is recorded: in these, kernels are compiled, libraries set up and
constants brought to the device."""
TOLERANCE = 0.1
"""Largest difference between a repeated step's change of a tensor and that of the step without it, relative to the
latter. The two are not the same to the bit, since sums are added up in any order on a GPU; a step with another draw,
learning rate or number differs by its whole size."""
LOSS_TOLERANCE = 0.01
"""Largest difference between the losses of both, relative to that of the step without a recording."""
TESTED = 0, 64
"""Numbers of repetitions of a recording before it is tested. In 64 steps an occupancy grid has been updated four times
and more, learning rates have changed, and other tensors may have moved."""
MOST_KINDS = 4
"""Number of kinds of steps whose recordings are kept, with the memory that each holds: those that were taken last."""
WAITED = "called a synchronizing CUDA operation"
"""What torch warns of where Python waits for a GPU, if it is asked to."""
FLAG = "--machine.cuda-graphs"


class Recorder(Protocol):
    """A way to record what a function starts on a device."""

    def run(self, function: Callable[[], T]) -> T:
        """Call `function` as it is recorded later, and return its result."""

    def watched(self, function: Callable[[], T]) -> tuple[T, str | None]:
        """Call `function` likewise, and return its result, and where it waited for the device; None if nowhere."""

    def record(self, function: Callable[[], T]) -> tuple[T, Callable[[], None]]:
        """Record `function` without running what it starts.

        Returns:
            Its result, whose tensors get their values when what was recorded runs, and a function that runs it.
        """


class CudaRecorder:
    """CUDA graphs on a stream of their own, as autograd's nodes must run on the stream on which they were made.

    Args:
        device: the GPU.
    """

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
        """Call `function` on the stream, and return its result, and where it waited for the GPU; None if nowhere.

        A recording of what waits fails, and leaves torch's allocator and generator in a state from which nothing goes
        on; so this is found out before.
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
        """Record `function` as a graph, and return its result, with the graph's memory, and what replays it.

        Raises:
            ConfigError: if that fails, and leaves the GPU or its generator in a state from which nothing can go on.
        """
        graph = torch.cuda.CUDAGraph()
        gc.collect()  # as torch itself does up to 2.8
        collecting = gc.isenabled()
        gc.disable()  # to free a kernel or another graph while one is recorded would spoil it
        try:
            with torch.cuda.graph(graph, stream=self.stream):
                result = function()
        except Exception as failure:
            try:
                torch.rand((), device=self.device)
                torch.cuda.synchronize(self.device)
            except RuntimeError:
                raise ConfigError(f"recording a CUDA graph failed ({_one_line(failure)}); use {FLAG} off") from failure
            raise
        finally:
            if collecting:
                gc.enable()
        return result, graph.replay


@dataclass
class _Kind(Generic[T]):
    """A kind of step: how many of it were taken, and its recording."""

    taken: int = 0
    """Number of steps that were taken to warm up."""
    recorded: tuple[T, Callable[[], None]] | None = None
    """The result of the recorded step, and what repeats it."""
    repeated: int = 0
    """Number of steps that were taken by repeating it."""
    passed: int = 0
    """Number of tests in which repeating it has done what the step itself does."""


class StepGraphs(Generic[T]):
    """Steps of a run, recorded and repeated by their kind.

    Args:
        recorder: records them.
        learnt: returns all tensors that a step changes for good: parameters, and the optimiser's state.
        must: whether a step that cannot be recorded is an error.
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
        """Number of steps that were taken by repeating one."""
        self._kinds: dict[Hashable, _Kind[T]] = {}
        self._told: set[str] = set()
        self._given_up = self._announced = False

    def forget(self) -> None:
        """Drop all recordings, since tensors have moved."""
        self._kinds.clear()

    def take(self, kind: StepKind) -> bool:
        """Return whether a step of a `kind` is to be taken by `run`; if not, say why, once.

        Raises:
            ConfigError: if it is not, and must be.
        """
        if kind.varies is not None:
            self._refuse(kind.varies)
        return kind.varies is None and not self._given_up

    def run(self, kind: StepKind, seed: Callable[[], None], step: Callable[[], T]) -> T:
        """Take a step, by repeating a recorded one of the same kind if there is one.

        Args:
            kind: its kind.
            seed: seeds the generators for this step.
            step: takes it; a function of the values of tensors, and of `kind`, alone.

        Returns:
            The step's result. Its tensors are written to by the next step.

        Raises:
            ConfigError: if the step cannot be recorded, and must be.
        """
        kept = self._kinds[kind.of] = self._kinds.pop(kind.of, _Kind())  # the last one taken is the last in the table
        if len(self._kinds) > MOST_KINDS:
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
        if kept.passed < len(TESTED) and kept.repeated >= TESTED[kept.passed]:
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
        except Exception as error:  # of torch, CUDA or Triton: any of them may find what cannot be recorded
            self._give_up(f"recording one failed ({_one_line(error)})")

    def _test(self, kept: _Kind[T], seed: Callable[[], None], step: Callable[[], T]) -> T:
        """Take a step without and with its recording, and drop the latter if they differ."""
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
            fault = "change what the step itself changes"
        if self._loss is not None and not _close(self._loss(result), wanted):
            fault = "have the loss of the step itself"
        if fault is not None:
            _restore(tensors, after)
            self._give_up(f"a repeated step did not {fault}")
            return expected
        tells = bool((moved > 0).any())  # a step that was dropped tells nothing
        kept.passed += tells
        if tells and not self._announced:
            self._announced = True
            say("training steps are recorded as CUDA graphs and repeated")
        return result

    def _give_up(self, why: str) -> None:
        self._given_up = True
        self._kinds.clear()
        self._refuse(why)

    def _refuse(self, why: str) -> None:
        if self._must:
            raise ConfigError(f"{FLAG} on: steps cannot be repeated as CUDA graphs, because {why}; leave it out")
        if why not in self._told:
            self._told.add(why)
            say(f"note: steps are not repeated as CUDA graphs, because {why}")


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:200]


def _copies(tensors: Sequence[Tensor]) -> list[Tensor]:
    return [tensor.detach().clone() for tensor in tensors]


@torch.no_grad()
def _restore(tensors: Sequence[Tensor], values: Sequence[Tensor]) -> None:
    for tensor, value in zip(tensors, values, strict=True):
        tensor.copy_(value)


def _close(loss: Tensor, wanted: Tensor | None) -> bool:
    """Return whether a loss is that which is wanted, or neither is finite."""
    assert wanted is not None
    return bool(torch.isclose(loss, wanted, LOSS_TOLERANCE, 0.0) | ~(loss.isfinite() | wanted.isfinite()))


@torch.no_grad()
def _distance(some: Sequence[Tensor], others: Sequence[Tensor]) -> Tensor:
    """Return the Euclidean distance between each two tensors, (K,) float64; what is infinite in both is alike."""
    pairs = zip(some, others, strict=True)
    return torch.stack([torch.where(a == b, 0.0, a.double() - b.double()).norm() for a, b in pairs])


def make_graphs(
    mode: str,
    device: torch.device,
    learnt: Callable[[], Sequence[Tensor]],
    loss: Callable[[Any], Tensor] | None = None,
) -> StepGraphs[Any] | None:
    """Return the recorded steps of a run; None if they are switched off or the device has no graphs.

    Args:
        mode: auto, on or off, as configured.
        device: the device of training.
        learnt: returns all tensors that a step changes for good.
        loss: returns the loss () of a step's result; None if there is none.

    Raises:
        ConfigError: if they are switched on, and the device has none.
    """
    if mode == "on" and device.type != "cuda":
        raise ConfigError(f"{FLAG} on: only GPUs that PyTorch names cuda have graphs, and this run is on {device.type}")
    if mode == "off" or device.type != "cuda":
        return None
    return StepGraphs(CudaRecorder(device), learnt, mode == "on", loss)


def kind_of_step(model: Model[Any], source: BatchSource, step: int, batch: tuple[Hashable, ...]) -> StepKind:
    """Return the kind of a whole training step, the drawing of its batch included.

    Args:
        model: the model to train.
        source: source of the batches.
        step: number of training steps done.
        batch: the numbers that the source is asked for.
    """
    if processes().count > 1:
        return StepKind(varies="several processes exchange their gradients")
    if source.varies is not None:
        return StepKind(varies=source.varies)
    if type(model).after_step is not Model.after_step:
        return StepKind(varies="the number of parameters changes")
    own = model.step_kind(step)
    return StepKind((*batch, *own.of), own.varies)
