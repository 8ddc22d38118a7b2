"""Small functions in a form that avoids overflow, cancellation and NaN gradients."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from nerfloom.geometry.limits import at_least

MAX_LOG_DENSITY = 15.0
"""Maximum log-density; larger values are clamped."""


def at_least_float32(values: Tensor) -> Tensor:
    """Convert `values` of types other than float64 to float32."""
    return values if values.dtype == torch.float64 else values.float()


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
    """Return exp(min(x, 15)). The gradient is the result itself, so that a density that is too high can decrease.

    This is Instant-NGP's `trunc_exp`. In half precision exp would overflow for `x` above 11, so types other than
    float64 are converted to float32.
    """
    return _TruncatedExp.apply(at_least_float32(x))


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
    """Return the density (N,), the `truncated_exp` of the first feature, and the `features` (N, F) themselves.

    It equals slicing, but computes the sum of the two gradients in one pass.
    """
    return _SplitDensity.apply(at_least_float32(features))


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
    """Return `values` (N, ...) unchanged, with their gradient multiplied by `factors` (N,)."""
    return _ScaledGradient.apply(values, factors)


def safe_normalize(v: Tensor, eps: float = 1e-12) -> Tensor:
    """Return v / |v| along the last dimension; NaN if v is not finite.

    v is first divided by its largest component, because in float32 the squares of components above 1.8e19 are infinite.

    Args:
        v: (..., D) vectors.
        eps: minimum length; shorter vectors have a result and a gradient of 0.
    """
    least = max(eps, torch.finfo(v.dtype).tiny)  # 1e-12 would be 0 in float16
    scaled = v / v.detach().abs().amax(-1, keepdim=True).clamp(min=least)  # shorter than 1 if |v| < least
    squared = (scaled * scaled).sum(-1, keepdim=True)
    return (scaled / at_least(squared, 1.0).sqrt()).masked_fill(squared < 1, 0)


def cross_matrix(v: Tensor) -> Tensor:
    """Return the cross-product matrices (..., 3, 3) of `v` (..., 3): their product with a vector w is `v` x w."""
    x, y, z = v.unbind(-1)
    zero = torch.zeros_like(x)
    rows = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1)
    return rows.unflatten(-1, (3, 3))
