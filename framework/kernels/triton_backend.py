"""Kernels for GPUs, in Triton: whether they can run, and their import on first use.

They are in files NAME_triton.py beside their references. Triton comes with PyTorch for CUDA and ROCm, and compiles a
kernel when it first runs. These files are imported only then, so they cost a user of the CPU nothing.

With `TRITON_INTERPRET=1` in the environment, Triton's interpreter runs the kernels on the CPU instead, for tests. There
the C++ kernels take precedence, unless `NERFLOOM_KERNELS=triton` excludes them. `NERFLOOM_KERNELS=reference` excludes
both.
"""

from __future__ import annotations

import functools
import importlib
import os
from collections.abc import Callable
from typing import Any

import torch

from nerfloom.base.console import say
from nerfloom.base.errors import ConfigError

INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"
"""True if Triton's interpreter runs the kernels on the CPU. Triton reads the variable when it is imported."""
MIN_CAPABILITY = (8, 0)
"""Minimum compute capability of NVIDIA's GPUs for Triton."""


@functools.cache
def available() -> bool:
    """Return whether these kernels are used.

    Raises:
        ConfigError: if NERFLOOM_KERNELS selects them and they cannot run.
    """
    asked = os.environ.get("NERFLOOM_KERNELS")
    if asked == "reference":
        return False
    problem = _problem()
    if problem is None:
        return True
    if asked == "triton":
        raise ConfigError(f"NERFLOOM_KERNELS asks for 'triton', but {problem}")
    if torch.cuda.is_available():
        say(f"note: {problem}; on this GPU nerfloom runs PyTorch's own operations, which are slower")
    return False


def _problem() -> str | None:
    """Return why the kernels cannot run here; None if they can."""
    try:
        importlib.import_module("triton")
    except ImportError as error:
        return f"Triton cannot be imported ({error}): pip install triton"
    if INTERPRETED:
        return None
    if not torch.cuda.is_available():
        return "this machine has no GPU usable by this PyTorch; TRITON_INTERPRET=1 runs the kernels on the CPU"
    capability = torch.cuda.get_device_capability()
    if torch.version.hip is None and capability < MIN_CAPABILITY:
        return f"Triton needs a GPU of compute capability {'.'.join(map(str, MIN_CAPABILITY))} or more, not " + (
            ".".join(map(str, capability))
        )
    return None


def later(file: str, name: str) -> Callable[..., Any]:
    """Return a function that imports another function and calls it.

    Args:
        file: name of a module in `nerfloom.kernels`, with its family's.
        name: name of a function in it.
    """

    def call(*args: Any, **kwargs: Any) -> Any:
        module = importlib.import_module(f"nerfloom.kernels.{file}")
        return getattr(module, name)(*args, **kwargs)

    return call
