"""The device of a run, its memory and speed, and its random streams."""

from __future__ import annotations

import math
import os
import platform
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import torch
from torch import Tensor

from nerfloom.base.errors import ConfigError
from nerfloom.base.machine_config import MachineConfig
from nerfloom.base.processes import processes

GPU_SPEED = 10.0
"""Speed of a GPU in training, relative to two threads of a CPU."""
BEFORE_STEP, AFTER_STEP = -1, -2
"""Random streams of a step that all processes share; they take the place of a process's number."""


def choose_device(machine: MachineConfig) -> torch.device:
    """Return the device of a config, and set its number of CPU threads.

    Processes on the same machine share its cores; each has its own GPU.

    Args:
        machine: the device type and the number of threads.

    Raises:
        ConfigError: if this machine lacks the device.
    """
    several = processes()
    if machine.num_threads is not None:
        torch.set_num_threads(machine.num_threads)
    elif several.local_count > 1:  # torchrun has set it to 1
        torch.set_num_threads(max(num_cores() // several.local_count, 1))
    kind = device_kind(machine)
    if kind != "cpu" and not {"cuda": torch.cuda, "mps": torch.backends.mps}[kind].is_available():
        raise ConfigError(f"--machine.device-type {kind}: this machine or this torch has none")
    if kind != "cuda" or several.count == 1:
        return torch.device(kind)
    if several.local_rank >= torch.cuda.device_count():
        found = f"{torch.cuda.device_count()} GPUs for {several.local_count} processes"
        raise ConfigError(f"this machine has {found}; --nproc-per-node must not be more")
    torch.cuda.set_device(several.local_rank)
    return torch.device(kind, several.local_rank)


def device_kind(machine: MachineConfig) -> str:
    """Return the kind of device that `machine` asks for, whether or not there is one: "cpu", "cuda" or "mps"."""
    if machine.device_type != "auto":
        return machine.device_type
    return "cuda" if torch.cuda.is_available() else "cpu"


def relative_speed(machine: MachineConfig) -> float:
    """Return the speed of training on this machine, relative to two CPU threads.

    The speed is `machine.speed` if set. On a CPU it is estimated from torch's number of threads, with a serial part of
    a quarter of a step on two threads (Amdahl 1967). Measured: one thread is 0.55 to 0.58 times as fast as two; 4 and 8
    threads are 1.7 and 2.3 times as fast. A GPU counts as ten: a data-centre GPU, shared with three other runs, was six
    times as fast in samples of instant-ngp. With several processes the result is 1, since all must decide the same.

    Args:
        machine: the device type, and the speed if it was given or measured.
    """
    if processes().count > 1:
        return 1.0
    if machine.speed is not None:
        return machine.speed
    if device_kind(machine) != "cpu":
        return GPU_SPEED
    return 1 / (0.25 + 1.5 / torch.get_num_threads())


def num_cores() -> int:
    """Return the number of CPU cores that this process may use."""
    allowed = getattr(os, "sched_getaffinity", None)  # Linux alone
    return len(allowed(0)) if allowed is not None else os.cpu_count() or 1


def num_gpus(device_type: str) -> int:
    """Return the number of GPUs that a process with this `device_type` asks for: 1 if it computes with CUDA, else 0."""
    return int(device_type == "cuda" or (device_type == "auto" and torch.cuda.is_available()))


def has_bfloat16(device: torch.device) -> bool:
    """Return whether `device` multiplies bfloat16 matrices in hardware."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported()
    return device.type == "cpu" and bool({"amx_bf16", "avx512_bf16"} & cpu_features())


def to_float64(values: Tensor) -> Tensor:
    """Return `values` in float64, on the CPU if their device is MPS, which lacks float64."""
    return (values.cpu() if values.device.type == "mps" else values).double()


def runs_ahead(device: torch.device) -> bool:
    """Return whether `device` runs asynchronously, so that reading a value waits for the device."""
    return device.type != "cpu"


class StepValue:
    """A number that changes from step to step: a float on the CPU, a tensor on other devices.

    The tensor is always the same one, so that a replayed CUDA graph reads the current number. Setting it does not wait
    for the device.

    Args:
        value: the first number.
    """

    def __init__(self, value: float) -> None:
        self._value = value
        self._there: Tensor | None = None

    def set(self, value: float) -> None:
        """Change the number to `value`."""
        self._value = value
        if self._there is not None:
            self._there.fill_(value)

    def on(self, device: torch.device) -> float | Tensor:
        """Return the number on `device`: a float, or () float32 if the device runs ahead of Python."""
        if not runs_ahead(device):
            return self._value
        if self._there is None or self._there.device != device:
            self._there = torch.full((), self._value, device=device)
        return self._there


class HostValue:
    """The value of a scalar tensor in Python, read from the device only when it has changed."""

    def __init__(self) -> None:
        self._state, self._value = (0, -1), 0.0

    def of(self, scalar: Tensor) -> float:
        """Return the value of `scalar` (). Pass the same tensor in each call; it may be changed in place."""
        state = scalar.data_ptr(), scalar._version
        if state != self._state:
            self._state, self._value = state, float(scalar)
        return self._value

    def change(self, scalar: Tensor, value: float) -> None:
        """Set `scalar` to a `value` that float32 represents exactly, without waiting for the device."""
        scalar.fill_(value)
        self._state, self._value = (scalar.data_ptr(), scalar._version), value


@cache
def cpu_features() -> frozenset[str]:
    """Return the CPU's instruction sets by their Linux names; on other systems, AVX2 and AVX-512 as PyTorch reports."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        levels = {"AVX2": {"avx2", "fma"}, "AVX512": {"avx2", "fma", "avx512f", "avx512bw", "avx512dq", "avx512vl"}}
        return frozenset(levels.get(torch.backends.cpu.get_cpu_capability(), ()))
    return next((frozenset(line.split(":", 1)[1].split()) for line in lines if line.startswith("flags")), frozenset())


def seed_step(seed: int, step: int, stream: int = 0) -> None:
    """Seed PyTorch's generators for one step.

    Every random number is then a function of (seed, step, stream): a resumed run has the same bits as an uninterrupted
    one, and random numbers drawn by an evaluation between two steps have no effect.

    Args:
        seed: the run's seed.
        step: the step's number.
        stream: number of the process, or a stream that all processes share.
    """
    number = stream_seed(seed, step, stream)
    torch.default_generator.manual_seed(number)
    if torch.cuda.is_initialized():  # before that, torch.manual_seed would queue every call until CUDA starts
        torch.cuda.manual_seed_all(number)
    if torch.backends.mps.is_available():
        torch.mps.manual_seed(number)


@contextmanager
def shared_stream(seed: int, step: int, stream: int) -> Iterator[None]:
    """Draw the same random numbers in all processes within a `with` block.

    `seed` is the run's, `stream` is BEFORE_STEP or AFTER_STEP of a `step`. There is no effect with a single
    process.
    """
    if processes().count == 1:
        yield
        return
    with torch.random.fork_rng([torch.cuda.current_device()] if torch.cuda.is_initialized() else []):
        seed_step(seed, step, stream)
        yield


def stream_seed(seed: int, step: int, stream: int = 0) -> int:
    """Return the seed of a random `stream` of a `step`, mixed with the run's `seed` into an integer of 63 bits."""
    state = 0x9E3779B97F4A7C15
    for value in (seed, step, stream) if stream else (seed, step):
        state = ((state ^ (value & 0xFFFFFFFFFFFFFFFF)) * 0xBF58476D1CE4E5B9) & 0xFFFFFFFFFFFFFFFF
        state ^= state >> 31
    return state >> 1


def peak_memory(device: torch.device) -> int:
    """Return the peak memory use in bytes.

    Args:
        device: for CUDA, the peak is the device's; otherwise it is the process's.

    Returns:
        The peak, or 0 if the system does not report it.
    """
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    try:
        import resource
    except ImportError:  # Windows
        return 0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if platform.system() == "Darwin" else peak * 1024


def free_memory(device: torch.device) -> float:
    """Return the free memory of a GPU in bytes; infinity for other devices, which share the machine's memory."""
    return float(torch.cuda.mem_get_info(device)[0]) if device.type == "cuda" else math.inf


def wait_for(device: torch.device) -> None:
    """Wait until all pending work on `device` has finished."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def machine_memory() -> float:
    """Return the memory in bytes of this machine, or the limit of its container; infinity if unknown."""
    try:
        limit = float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    except (AttributeError, ValueError, OSError):  # Windows
        limit = math.inf
    for file in ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"):
        try:
            limit = min(limit, float(Path(file).read_text()))
        except (OSError, ValueError):  # "max"
            continue
    return limit
