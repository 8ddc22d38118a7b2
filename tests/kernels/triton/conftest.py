"""Triton's kernels are tested on a GPU, or else by Triton's interpreter, which tests/kernels/test_triton.py starts."""

import importlib.util

import torch

from nerfloom.benchmarks.kernel_errors import faster_interpreter
from nerfloom.kernels import triton_backend

if importlib.util.find_spec("triton") is None or not (triton_backend.INTERPRETED or torch.cuda.is_available()):
    collect_ignore_glob = ["test_*.py"]
elif triton_backend.INTERPRETED:
    faster_interpreter()
