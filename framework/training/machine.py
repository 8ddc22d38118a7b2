"""Description of the machine and the versions, for measurements."""

from __future__ import annotations

import os
import platform
import subprocess
from pathlib import Path
from typing import Any

import torch

import nerfloom
from nerfloom.base.device import machine_memory
from nerfloom.kernels import native, triton_backend


def machine(device: torch.device | None = None) -> dict[str, Any]:
    """Return processor, cores, threads, memory, `device` (None: CPU), kernels, versions and commit, as plain data."""
    on_cuda = device is not None and device.type == "cuda"
    memory = machine_memory()
    return {
        "processor": processor(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "memory, GB": round(memory / 1e9, 1) if memory < float("inf") else None,
        "device": torch.cuda.get_device_name(device) if on_cuda else (device.type if device is not None else "cpu"),
        "kernels": kernels(device),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "torch": torch.__version__,
        "nerfloom": nerfloom.__version__,
        "commit": commit(),
    }


def kernels(device: torch.device | None = None) -> str:
    """Return the variant of compiled kernels on `device` (None: the CPU), "triton", or "reference" for torch alone."""
    if device is None or device.type == "cpu":
        return native.variant()
    return "triton" if device.type == "cuda" and triton_backend.available() else "reference"


def processor() -> str:
    """Return the name of the CPU, or its architecture if the system does not name it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    names = (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    return next(names, "") or platform.processor() or platform.machine()


def commit() -> str | None:
    """Return the commit of the running checkout, with + for local changes; None for an installed package."""
    root = Path(nerfloom.__file__).parents[1]
    if not (root / ".git").exists():
        return None
    try:
        head = _git(root, "rev-parse", "--short=12", "HEAD")
        return head + ("+" if _git(root, "status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.SubprocessError):
        return None


def _git(root: Path, *words: str) -> str:
    done = subprocess.run(["git", "-C", root, *words], capture_output=True, text=True, timeout=10, check=True)
    return done.stdout.strip()
