"""Description of the environment for error reports: versions, processor, kernels, GPU, memory and extras."""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import nerfloom
from nerfloom.base.extras import EXTRAS, install_command

PACKAGES = ("numpy", "tyro", "rich", "imageio", "pillow", "PyYAML", "pycolmap", "tensorboard", "jinja2", "triton")
"""Packages with versions to list, in addition to torch."""
VARIABLES = ("NERFLOOM_", "OMP_", "KMP_", "GOMP_", "MKL_", "CUDA_VISIBLE_DEVICES", "PYTORCH_")
"""Prefixes of environment variables that affect results."""


def environment() -> str:
    """Return a table of the environment, one line per item; unknown items give the reason."""
    rows: dict[str, Callable[[], str]] = {
        "nerfloom": _nerfloom,
        "Python": lambda: f"{platform.python_version()} ({platform.python_implementation()}), {sys.executable}",
        "torch": _torch,
        "kernels": _kernels,
        "CPU": _cpu,
        "GPU": _gpu,
        "memory": _memory,
        "system": lambda: f"{platform.platform()}, {platform.machine()}",
        "packages": lambda: ", ".join(f"{name} {_version(name)}" for name in PACKAGES),
        "extras": _extras,
        "variables": _variables,
    }
    return "\n".join(f"{name:<10}{_said(value)}" for name, value in rows.items())


def _said(value: Callable[[], str]) -> str:
    """Return an item's text, or the error: reports often come from broken installations."""
    try:
        return value()
    except Exception as error:
        return f"unknown: {type(error).__name__}: {' '.join(str(error).split())[:300]}"


def _nerfloom() -> str:
    from nerfloom.training.machine import commit

    here = commit()
    return f"{nerfloom.__version__} from {Path(nerfloom.__file__).parent}" + (f", commit {here}" if here else "")


def _torch() -> str:
    import torch

    builds = [name for name, value in (("CUDA", torch.version.cuda), ("ROCm", torch.version.hip)) if value]
    return f"{torch.__version__}, {torch.get_num_threads()} threads, built for {' and '.join(builds) or 'the CPU'}"


def _kernels() -> str:
    from nerfloom.kernels import native, triton_backend

    built = sorted(path.stem for path in native.FOLDER.glob(f"*{native.SUFFIX}"))
    triton = "can be used" if triton_backend.available() else "cannot be used"
    return f"{native.variant()} on the CPU (built: {', '.join(built) or 'none'}); triton {triton}"


def _cpu() -> str:
    from nerfloom.base.device import cpu_features, num_cores
    from nerfloom.kernels.native import NEEDS
    from nerfloom.training.machine import processor

    relevant = {feature for needs in NEEDS.values() for feature in needs}
    sets = ", ".join(sorted(cpu_features() & relevant)) or "none of the kernels' instruction sets"
    return f"{processor()}, {num_cores()} of {os.cpu_count()} cores; {sets}"


def _gpu() -> str:
    import torch

    if torch.backends.mps.is_available():
        return "Apple's, by MPS"
    if not torch.cuda.is_available():
        return "none that torch can use"
    found = [torch.cuda.get_device_properties(index) for index in range(torch.cuda.device_count())]
    names = [f"{gpu.name} ({gpu.total_memory / 1e9:.0f} GB, {gpu.major}.{gpu.minor})" for gpu in found]
    return f"{', '.join(names)}; CUDA {torch.version.cuda or 'none'}, ROCm {torch.version.hip or 'none'}"


def _memory() -> str:
    from nerfloom.base.device import machine_memory

    memory = machine_memory()
    return f"{memory / 1e9:.1f} GB" if memory < float("inf") else "unknown"


def _extras() -> str:
    missing = {extra: install_command(extra) for extra in EXTRAS}
    return ", ".join(f"{extra}: {'installed' if command is None else command}" for extra, command in missing.items())


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "missing"


def _variables() -> str:
    found = [f"{name}={value}" for name, value in sorted(os.environ.items()) if name.startswith(VARIABLES)]
    return ", ".join(found) or "none"
