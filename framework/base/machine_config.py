"""Settings of a run's machine and viewer."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from nerfloom.base.errors import ConfigError, shown

MAX_THREADS = 1024
"""Maximum number of CPU threads."""


@dataclass(frozen=True)
class MachineConfig:
    """The device of a run, its threads and its seed."""

    seed: int = 42
    """Random seed. The same seed, CPU and thread count give the same bits; on a GPU, rounding differs between runs."""
    device_type: Literal["auto", "cpu", "cuda", "mps"] = "auto"
    """Device to train on; auto: CUDA if available, else the CPU."""
    num_threads: int | None = None
    """CPU threads. Default: all cores."""
    speed: float | None = None
    """Training speed relative to two idle cores of the server that settings were tuned on. Default: measured on a CPU
    if --max-seconds is at least 10, else estimated from the number of threads."""
    cuda_graphs: Literal["auto", "on", "off"] = "auto"
    """Capture training steps on a GPU as CUDA graphs, which saves the time to launch each operation. auto: if steps
    repeat and a replayed step gives the same loss and update as an ordinary one; a message says why not."""

    def __post_init__(self) -> None:
        if not -(2**63) <= self.seed < 2**63:
            raise ConfigError(f"--machine.seed is {shown(self.seed)}; it must be an integer of 64 bits")
        if self.num_threads is not None and not 1 <= self.num_threads <= MAX_THREADS:
            number = shown(self.num_threads)
            raise ConfigError(f"--machine.num-threads is {number}; it must be from 1 to {MAX_THREADS}")
        if self.speed is not None and not 0 < self.speed < math.inf:
            raise ConfigError(f"--machine.speed is {shown(self.speed)}; it must be more than 0")


@dataclass(frozen=True)
class ViewerConfig:
    """The address of the viewer."""

    websocket_host: str = "127.0.0.1"
    """Interface to listen on; 0.0.0.0: all, so that other machines can connect. There is no password."""
    websocket_port: int = 7007
    """Port to listen on, or the next free one."""

    def __post_init__(self) -> None:
        if not 1 <= self.websocket_port <= 65535:
            raise ConfigError(f"--viewer.websocket-port is {shown(self.websocket_port)}; it must be from 1 to 65535")
