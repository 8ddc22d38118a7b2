"""Triton's kernels are tested on a GPU, or else by Triton's interpreter, which tests/kernels/test_triton.py starts."""

import importlib.util

import torch

from nerfloom.kernels import triton_kernels
from nerfloom.tools.benchmarks.kernel_errors import faster_interpreter

if importlib.util.find_spec("triton") is None or not (triton_kernels.INTERPRETED or torch.cuda.is_available()):
    collect_ignore_glob = ["test_*.py"]
elif triton_kernels.INTERPRETED:
    faster_interpreter()
