"""Where a run computes, and in which precision."""

from __future__ import annotations

import math
import os
import platform
from functools import cache
from pathlib import Path

import torch
from torch import Tensor

from framework.base.config import MachineConfig
from framework.base.errors import ConfigError

MOST_THREADS = 1024
"""That a file of settings may ask for: where the system refuses to start as many, OpenMP ends the process."""


def choose_device(machine: MachineConfig) -> torch.device:
    """The device asked for, with its threads set.

    Raises: ConfigError where this machine does not have it, or the number of threads is none.
    """
    if machine.num_threads is not None:
        if not 1 <= machine.num_threads <= MOST_THREADS:
            raise ConfigError(f"--machine.num-threads is {machine.num_threads}; it must be from 1 to {MOST_THREADS}")
        torch.set_num_threads(machine.num_threads)
    available = {"cpu": True, "cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available()}
    if machine.device_type == "auto":
        return torch.device("cuda" if available["cuda"] else "cpu")
    if not available[machine.device_type]:
        raise ConfigError(f"--machine.device-type {machine.device_type}: this machine or this torch has none")
    return torch.device(machine.device_type)


def has_bfloat16(device: torch.device) -> bool:
    """Whether the device multiplies bfloat16 matrices in hardware."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported()
    return device.type == "cpu" and bool({"amx_bf16", "avx512_bf16"} & processor_features())


def exact(values: Tensor) -> Tensor:
    """Values in float64: on the processor where their device, MPS, has none, else where they are."""
    return (values.cpu() if values.device.type == "mps" else values).double()


@cache
def processor_features() -> frozenset[str]:
    """Instruction sets of this processor, in Linux's names; elsewhere what torch found of AVX2 and AVX-512."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        found = {"AVX2": {"avx2", "fma"}, "AVX512": {"avx2", "fma", "avx512f", "avx512bw", "avx512dq", "avx512vl"}}
        return frozenset(found.get(torch.backends.cpu.get_cpu_capability(), ()))
    return next((frozenset(line.split(":", 1)[1].split()) for line in lines if line.startswith("flags")), frozenset())


def seed_step(seed: int, step: int) -> None:
    """Give step `step` its own random stream.

    Every draw is then a function of (seed, step): a resumed run repeats an uninterrupted one bit for bit, and
    what an evaluation between two steps draws does not matter.
    """
    number = stream_seed(seed, step)
    torch.default_generator.manual_seed(number)
    if torch.cuda.is_initialized():  # torch.manual_seed would note every call for a CUDA that may come later
        torch.cuda.manual_seed_all(number)
    if torch.backends.mps.is_available():
        torch.mps.manual_seed(number)


def stream_seed(seed: int, step: int) -> int:
    """A well mixed 63-bit number: the seed of the random stream of one step."""
    state = 0x9E3779B97F4A7C15
    for value in (seed, step):
        state = ((state ^ (value & 0xFFFFFFFFFFFFFFFF)) * 0xBF58476D1CE4E5B9) & 0xFFFFFFFFFFFFFFFF
        state ^= state >> 31
    return state >> 1


def peak_memory(device: torch.device) -> int:
    """Most memory held so far, bytes: the device's on CUDA, else the process's; 0 where the system does not tell."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    try:
        import resource
    except ImportError:  # Windows
        return 0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if platform.system() == "Darwin" else peak * 1024


def wait_for(device: torch.device) -> None:
    """Let pending work end, so that a clock can be read."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def machine_memory() -> float:
    """Bytes of memory that this machine, or the container around this process, has; infinity where neither is told."""
    try:
        found = float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    except (AttributeError, ValueError, OSError):  # Windows
        found = math.inf
    for file in ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"):
        try:
            found = min(found, float(Path(file).read_text()))
        except (OSError, ValueError):  # "max"
            continue
    return found
