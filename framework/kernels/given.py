"""Checks of tensors that came from outside. Compiled kernels check indices themselves, as they use them."""

from __future__ import annotations

import torch
from torch import Tensor


def is_followed(*tensors: Tensor | None) -> bool:
    """Whether autograd follows any of the tensors: what a kernel has no gradient for is left to torch then."""
    return torch.is_grad_enabled() and any(tensor is not None and tensor.requires_grad for tensor in tensors)


def check_indices(indices: Tensor, count: int, what: str) -> None:
    """Check indices into `count` things.

    On the processor only: elsewhere a look at them would wait for the device, which reports what is too large itself.

    Raises: IndexError that names `what`, the first end that is out of range, and the range.
    """
    if indices.device.type != "cpu" or indices.numel() == 0:
        return
    least, most = (int(end) for end in indices.aminmax())
    if least < 0 or most >= count:
        raise IndexError(f"{what}: index {least if least < 0 else most} is out of range; there are {count}, from 0")


def check_offsets(offsets: Tensor, count: int) -> None:
    """Check that offsets (R + 1,) divide `count` samples between R rays. On the processor only, as above.

    Raises: IndexError.
    """
    if offsets.device.type != "cpu":
        return
    if offsets.ndim != 1 or len(offsets) == 0 or int(offsets[0]) != 0 or int(offsets[-1]) != count:
        raise IndexError(f"the rays' offsets must lead from 0 to {count}, the number of samples")
    if bool((offsets[1:] < offsets[:-1]).any()):
        raise IndexError("the rays' offsets must not fall: each ray's samples stand behind those of the one before")
