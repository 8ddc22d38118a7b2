"""Small functions whose plain form overflows, cancels or has a NaN gradient somewhere."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

MAX_LOG_DENSITY = 15.0


class _TruncatedExp(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        value = torch.exp(x.clamp(max=MAX_LOG_DENSITY))
        ctx.save_for_backward(value)
        return value

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        (value,) = ctx.saved_tensors
        return grad * value


def truncated_exp(x: Tensor) -> Tensor:
    """exp(min(x, 15)), with the gradient of the clipped value: a density that is too high can still come down.

    float32 whatever the input's type, for exp overflows half precision at 11 (Instant-NGP's `trunc_exp`).
    """
    return _TruncatedExp.apply(x.float() if x.dtype != torch.float64 else x)


def safe_normalize(v: Tensor, eps: float = 1e-12) -> Tensor:
    """v / |v| over the last dimension; 0, with a zero gradient, where |v| < eps."""
    squared = (v * v).sum(-1, keepdim=True)
    usable = squared > eps * eps
    return torch.where(usable, v / torch.where(usable, squared, torch.ones_like(squared)).sqrt(), torch.zeros_like(v))
