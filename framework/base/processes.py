"""Several processes that train one run: `torchrun --nproc-per-node N $(which ns-train) METHOD ...`.

Each process runs the same program on its own pixels or images. Only the first prints and writes. Processes exchange
tensors only through the functions here, called in the same order in each process. With one process they do nothing.
"""

from __future__ import annotations

import io
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

from nerfloom.base.console import console
from nerfloom.base.errors import ConfigError, LostProcessError

PATIENCE = timedelta(days=1)
"""Maximum time to wait for another process, which may be evaluating. An ended process is noticed at once."""
NAMES = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE")
"""Environment variables with torchrun's numbers of processes."""


@dataclass(frozen=True)
class Processes:
    """The rank of this process and the number of processes of a run."""

    rank: int = 0
    """Rank of this process, from 0."""
    count: int = 1
    """Number of processes."""
    local_rank: int = 0
    """Rank of this process on this machine."""
    local_count: int = 1
    """Number of processes on this machine."""

    @property
    def first(self) -> bool:
        """True in the process that prints and writes."""
        return self.rank == 0


_joined = Processes()


def processes() -> Processes:
    """Return the processes of this run; one process outside `joined_processes`."""
    return _joined


@contextmanager
def joined_processes() -> Iterator[Processes]:
    """Connect the processes that torchrun has started, within a `with` block. Only the first prints messages there.

    Raises:
        ConfigError: if they cannot connect.
    """
    global _joined
    started = _started()
    if started.count == 1:
        yield started
        return
    several = f"{started.count} processes were started"
    if not dist.is_available():
        raise ConfigError(f"{several}, but this torch cannot connect them; start one, or install another torch")
    backend = "cpu:gloo,cuda:nccl" if torch.cuda.is_available() and dist.is_nccl_available() else "gloo"
    try:
        dist.init_process_group(backend, timeout=PATIENCE)
    except (RuntimeError, ValueError) as error:
        raise ConfigError(f"{several}, but they cannot connect; start them with torchrun: {error}") from error
    _joined, console.quiet = started, not started.first
    try:
        yield started
    finally:
        _joined = Processes()
    dist.destroy_process_group()  # not after an error: it could wait for processes that have ended


@contextmanager
def alone() -> Iterator[None]:
    """Treat this process as the only one within a `with` block, for work with a result that is sent to the others."""
    global _joined
    before, _joined = _joined, Processes()
    try:
        yield
    finally:
        _joined = before


def _started() -> Processes:
    """Return the processes that torchrun has started, from its environment variables."""
    if not {"RANK", "WORLD_SIZE", "MASTER_ADDR"} <= os.environ.keys():
        return Processes()
    try:
        return Processes(*(int(os.environ.get(name, default)) for name, default in zip(NAMES, "0101", strict=True)))
    except ValueError as error:
        raise ConfigError(f"{', '.join(NAMES)}: these variables of torchrun must be numbers ({error})") from error


def gathered(values: Sequence[float]) -> list[list[float]]:
    """Return the `values` of all processes, one row per process; all pass the same number of them.

    Raises:
        LostProcessError: if another process has ended.
    """
    own = torch.tensor(values, dtype=torch.float64)
    if _joined.count == 1:
        return [own.tolist()]
    rows = [torch.empty_like(own) for _ in range(_joined.count)]
    _together(dist.all_gather, rows, own)
    return [row.tolist() for row in rows]


def add_up(values: Tensor) -> Tensor:
    """Sum a tensor over all processes, in place. All processes get the same bits.

    Args:
        values: a contiguous tensor with the same shape in each process.

    Returns:
        The same tensor.

    Raises:
        LostProcessError: if another process has ended.
    """
    if _joined.count > 1:
        _together(dist.all_reduce, values)
    return values


def from_first(content: Any, device: torch.device | str = "cpu") -> Any:
    """Return the first process's `content`: tensors, on `device` in the others, and plain data, as in checkpoints.

    Raises:
        LostProcessError: if another process has ended.
    """
    if _joined.count == 1:
        return content
    packed = io.BytesIO()
    if _joined.first:
        torch.save(content, packed)
    size = int(gathered([packed.tell()])[0][0])
    data = torch.frombuffer(packed.getbuffer() if _joined.first else bytearray(size), dtype=torch.uint8)
    _together(dist.broadcast, data, 0)
    if _joined.first:
        return content
    return torch.load(io.BytesIO(data.numpy().tobytes()), map_location=device, weights_only=True)


def _together(collective: Callable[..., Any], *arguments: Any) -> None:
    """Call a function of torch.distributed; raise LostProcessError if it fails because a process has ended."""
    try:
        collective(*arguments)
    except RuntimeError as error:
        raise LostProcessError("another process of this run has ended") from error
