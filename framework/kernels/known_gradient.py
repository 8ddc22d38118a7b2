"""Values with a known gradient: a kernel computes both in one pass, and the backward pass only multiplies."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


class KnownGradient(torch.autograd.Function):
    """The first of some tensors, () or (R,); the others are its gradients by the inputs, with the same first axis."""

    @staticmethod
    def forward(ctx: Any, computed: tuple[Tensor, ...], *inputs: Tensor) -> Tensor:
        """Return the value; `ctx` keeps its gradients, the rest of `computed`, by the `inputs`."""
        value, *gradients = computed
        ctx.save_for_backward(*gradients)
        return value

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        """Return the gradients that `ctx` keeps, times the gradient `grad` of the value."""
        if grad.ndim == 0 and grad.is_cpu and float(grad) == 1:  # as of a term of a loss: no pass over the gradients
            return None, *ctx.saved_tensors
        return None, *(each * grad.view(*grad.shape, *[1] * (each.ndim - grad.ndim)) for each in ctx.saved_tensors)
