"""Triton's kernels are tested on a GPU, or else by Triton's interpreter, which tests/kernels/test_triton.py starts."""

import importlib.util
from typing import Any

import torch

from framework.kernels import triton_kernels

if importlib.util.find_spec("triton") is None or not (triton_kernels.INTERPRETED or torch.cuda.is_available()):
    collect_ignore_glob = ["test_*.py"]
elif triton_kernels.INTERPRETED:
    from triton.language import core
    from triton.runtime import interpreter

    patch, patched = interpreter._patch_lang, set[int]()

    class _Kept:
        def restore(self) -> None:
            pass

    def _patch_once(function: Any) -> Any:
        if id(function.__globals__) not in patched:
            patched.add(id(function.__globals__))
            patch(function)
            # Triton 3.6's takes arrays of one number for numbers, which numpy 2.4 refuses.
            core.tensor.__index__ = lambda self: int(self.handle.data.squeeze())
        return _Kept()

    # The interpreter replaces Triton's functions at each call of each function, which takes most of the time.
    interpreter._patch_lang = _patch_once
