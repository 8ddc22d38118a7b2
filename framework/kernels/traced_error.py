"""The squared error of what traced rays show, and its gradient, in one compiled call.

`trace`, the colour network, `composite` and the mean of squares are the readable form (`traced_error_reference`), for
any loss. Where the loss is this mean alone, its gradient is known as soon as the colours are: `traced_error` takes a
block of rays there and back while it is in cache, and keeps the networks' activations for the way back
(`csrc/traced_error.cpp`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from framework.kernels import kept, native
from framework.kernels.dispatch import CPP
from framework.kernels.hash_grid import hash_grid
from framework.kernels.march import CompiledMarch, March
from framework.kernels.mlp import NETWORK, multiplies_bf16
from framework.kernels.trace import GridDensity, arguments, is_compiled, network

MAX_RAYS = 256
"""Maximum number of rays of a pixel."""


@dataclass(frozen=True)
class GridColor:
    """A colour: the sigmoid of `mlp` of the outputs of a `GridDensity` and of harmonics of the viewing direction."""

    bands: int
    """Bands of the harmonics; 0 for colours that do not depend on the direction."""
    weights: Sequence[Tensor]
    """(D_out, D_in) weights of each layer, without biases."""


class TracedError(NamedTuple):
    """The error of P pixels."""

    error: Tensor
    """() mean of weight * (colour - target)^2, with its gradient."""
    rgb: Tensor
    """(P, 3) colours, without gradient."""
    num_samples: int
    """Number of samples that light reached."""


def traced_error(
    marched: March,
    density: GridDensity,
    color: GridColor,
    background: Tensor,
    target: Tensor,
    weights: Tensor | None = None,
) -> TracedError | None:
    """Return the mean squared error of the colours of traced rays.

    Args:
        marched: the march of R rays, before its first wave.
        density: the density along the rays.
        color: the colour along the rays.
        background: (R, 3) colour behind each ray.
        target: (P, 3) true colours, of pixels of R / P consecutive rays, whose colours are averaged.
        weights: (P,) factors of the pixels; None for 1.

    Returns:
        What the plain operations would give; None where these would not run compiled, or without rays or gradient, so
        that the caller has to take them.
    """
    count, pixels = len(marched.rays), len(target)
    if not (isinstance(marched, CompiledMarch) and torch.is_grad_enabled() and 0 < count <= MAX_RAYS * pixels):
        return None
    given = [background, target] if weights is None else [background, target, weights]
    if marched.waves or any(tensor.requires_grad or tensor.dtype is not torch.float32 for tensor in given):
        return None
    if not is_compiled(marched, density) or not _is_compiled(color):
        return None
    rgb, error, samples = torch.empty(pixels, 3), torch.empty(()), torch.empty(1, dtype=torch.int64)
    networks = [density.weights, color.weights]
    grads = [[torch.empty_like(weight) for weight in each] for each in networks]
    background, target = background.contiguous(), target.contiguous()
    total = _traced_error(
        *arguments(marched, density), multiplies_bf16(), *network(color.weights), color.bands,
        native.pointer(background, "the background", (count, 3)), native.pointer(target, "the target", (pixels, 3)),
        None if weights is None else native.pointer(weights, "the pixels' weights", (pixels,)), count // pixels,
        rgb.data_ptr(), error.data_ptr(), *(native.pointers([g.data_ptr() for g in each]) for each in grads),
        samples.data_ptr(), native.threads(),
    )  # fmt: skip
    unit, encoded_grad = torch.empty(total, 3), torch.empty(total, density.weights[0].shape[1])
    _take(total, unit.data_ptr(), encoded_grad.data_ptr(), native.threads())
    with kept.given(hash_grid=encoded_grad):  # values do not matter: it is asked for the gradient of the table
        encoded = hash_grid(unit, density.table, density.layout, density.deferred)
    known = (encoded_grad, *grads[0], *grads[1])
    return TracedError(_Known.apply(error, known, encoded, *networks[0], *networks[1]), rgb, int(samples))


def _is_compiled(color: GridColor) -> bool:
    """Return whether the network of colours would run compiled."""
    inputs = (color.weights[0].detach(),)
    chosen = NETWORK.choose((*inputs, *color.weights), inputs, color.weights, "sigmoid")
    return chosen.backend is CPP and all(weight.is_contiguous() for weight in color.weights)


class _Known(torch.autograd.Function):
    """A value whose gradients are known already."""

    @staticmethod
    def forward(ctx: Any, value: Tensor, grads: Sequence[Tensor], *inputs: Tensor) -> Tensor:
        ctx.grads = grads
        return value.clone()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        factor = float(grad)
        return None, None, *(g if factor == 1 else g * factor for g in ctx.grads)


_traced_error: Callable[..., int] = native.Function(
    "traced_error", "ppppppqpipffppiifpppippipipi" "pipi" "pppq" "ppppp" "i", "q"
)
_take = native.Function("traced_error_take", "qppi")
