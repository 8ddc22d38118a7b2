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


class _SplitDensity(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, features: Tensor) -> tuple[Tensor, Tensor]:
        density = torch.exp(features[:, 0].clamp(max=MAX_LOG_DENSITY))
        ctx.save_for_backward(density)
        ctx.shape = features.shape
        ctx.set_materialize_grads(False)
        return density, features.view_as(features)

    @staticmethod
    def backward(ctx: Any, grad_density: Tensor | None, grad_features: Tensor | None) -> Tensor | None:
        (density,) = ctx.saved_tensors
        if grad_density is None:
            return grad_features
        out = grad_density.new_zeros(ctx.shape) if grad_features is None else grad_features.clone()
        out[:, 0] += grad_density * density
        return out


def split_density(features: Tensor) -> tuple[Tensor, Tensor]:
    """Density (N,), the `truncated_exp` of the first of F features, and the features (N, F) for the colour.

    The same as slicing, but the two gradients meet in one pass.
    """
    return _SplitDensity.apply(features if features.dtype == torch.float64 else features.float())


class _ScaledGradient(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, factors: Tensor) -> Tensor:
        ctx.save_for_backward(factors)
        return values.view_as(values)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        (factors,) = ctx.saved_tensors
        return grad * factors.view(-1, *[1] * (grad.ndim - 1)), None


def scale_gradient(values: Tensor, factors: Tensor) -> Tensor:
    """`values` (N, ...) as they are, their gradient multiplied by `factors` (N,)."""
    return _ScaledGradient.apply(values, factors)


def safe_normalize(v: Tensor, eps: float = 1e-12) -> Tensor:
    """v / |v| over the last dimension; 0, with a zero gradient, where |v| < eps; NaN where v is not finite.

    v is divided by its largest component first: in float32 the square of what is longer than 1.8e19 is infinite.
    """
    least = max(eps, torch.finfo(v.dtype).tiny)  # 1e-12 would be 0 in float16
    scaled = v / v.detach().abs().amax(-1, keepdim=True).clamp(min=least)  # shorter than 1 where |v| < least
    squared = (scaled * scaled).sum(-1, keepdim=True)
    return (scaled / squared.clamp(min=1).sqrt()).masked_fill(squared < 1, 0)


def cross_matrix(v: Tensor) -> Tensor:
    """(..., 3, 3) the matrices that take x to the cross product v x x, for vectors v (..., 3)."""
    x, y, z = v.unbind(-1)
    zero = torch.zeros_like(x)
    rows = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1)
    return rows.unflatten(-1, (3, 3))
