"""Checks of tensors passed by callers. Compiled kernels check indices themselves when they use them."""

from __future__ import annotations

import torch
from torch import Tensor


def is_followed(*tensors: Tensor | None) -> bool:
    """Return whether autograd records any of `tensors`, so that an operation on it must have a gradient."""
    return torch.is_grad_enabled() and any(tensor is not None and tensor.requires_grad for tensor in tensors)


def is_bad_here(scalar: Tensor) -> bool:
    """Return whether a `scalar` on the CPU is not finite; False on other devices, which would have to be waited for."""
    return scalar.device.type == "cpu" and not bool(torch.isfinite(scalar))


def check_indices(indices: Tensor, count: int | Tensor, what: str) -> None:
    """Check that indices are in range.

    Indices on devices other than the CPU are not checked: reading them would wait for the device, which itself reports
    indices out of range.

    Args:
        indices: integers of any shape.
        count: number of indexed items, possibly a tensor (), which is read only if there is a check.
        what: name of the items, for the error.

    Raises:
        IndexError: if an index is less than 0, or not less than `count`.
    """
    if indices.device.type != "cpu" or indices.numel() == 0:
        return
    count, (least, most) = int(count), (int(end) for end in indices.aminmax())
    if least < 0 or most >= count:
        raise IndexError(f"{what}: index {least if least < 0 else most} is out of range; there are {count}, from 0")


def check_offsets(offsets: Tensor, count: int) -> None:
    """Check that offsets divide samples between rays; on the CPU only, as in `check_indices`.

    Args:
        offsets: (R + 1,) int64 index of each ray's first sample; the last entry is the number of samples.
        count: number N of samples.

    Raises:
        IndexError: if the offsets do not increase from 0 to `count`.
    """
    if offsets.device.type != "cpu":
        return
    if offsets.ndim != 1 or len(offsets) == 0 or int(offsets[0]) != 0 or int(offsets[-1]) != count:
        raise IndexError(f"the rays' offsets must start at 0 and end at the number of samples, {count}")
    if bool((offsets[1:] < offsets[:-1]).any()):
        raise IndexError("the rays' offsets must not decrease: each ray's samples follow the ray before's")
