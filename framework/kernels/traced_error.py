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


THIN = 0.0


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


def knows(
    origins: Tensor, density: GridDensity, color: GridColor, background: Tensor, target: Tensor, weights: Tensor | None
) -> bool:
    """Return whether `traced_error` gives what plain operations would, which run compiled and with first derivatives.

    Args:
        origins: (R, 3) origins of the rays.
        density: the density along the rays.
        color: the colour along the rays.
        background: (R, 3) colour behind each ray.
        target: (P, 3) true colours of the pixels.
        weights: (P,) factors of the pixels; None for 1.
    """
    if not (torch.is_grad_enabled() and 0 < len(origins) <= MAX_RAYS * len(target)):
        return False
    given = [origins, background, target] if weights is None else [origins, background, target, weights]
    if any(tensor.requires_grad or tensor.dtype is not torch.float32 for tensor in given):
        return False
    network = NETWORK.choose((origins, *color.weights), (origins,), color.weights, "sigmoid")
    plain = network.backend is CPP and all(weight.is_contiguous() for weight in color.weights)
    return plain and is_compiled(origins, density)


def traced_error(
    marched: March,
    density: GridDensity,
    color: GridColor,
    background: Tensor,
    target: Tensor,
    weights: Tensor | None = None,
) -> TracedError | None:
    """Return the mean squared error of the colours of traced rays; None for a march that does not run compiled.

    Args:
        marched: the march of R rays, before its first wave.
        density: the density along the rays.
        color: the colour along the rays.
        background: (R, 3) colour behind each ray.
        target: (P, 3) true colours, of pixels of R / P consecutive rays, whose colours are averaged.
        weights: (P,) factors of the pixels; None for 1.
    """
    if not isinstance(marched, CompiledMarch):
        return None
    count, pixels = len(marched.rays), len(target)
    rgb, error, samples = torch.empty(pixels, 3), torch.empty(()), torch.empty(1, dtype=torch.int64)
    networks = [density.weights, color.weights]
    grads = [[torch.empty_like(weight) for weight in each] for each in networks]
    background, target = background.contiguous(), target.contiguous()
    weights = None if weights is None else weights.contiguous()
    total = _traced_error(
        *arguments(marched, density), multiplies_bf16(), *network(color.weights), color.bands,
        native.pointer(background, "the background", (count, 3)), native.pointer(target, "the target", (pixels, 3)),
        None if weights is None else native.pointer(weights, "the pixels' weights", (pixels,)), count // pixels,
        THIN, int(torch.randint(2**31, ())) if THIN else 0, rgb.data_ptr(), error.data_ptr(), *(native.pointers([g.data_ptr() for g in each]) for each in grads),
        samples.data_ptr(), native.threads(),
    )  # fmt: skip
    unit, encoded_grad = torch.empty(total, 3), torch.empty(total, density.weights[0].shape[1])
    _take(total, unit.data_ptr(), encoded_grad.data_ptr(), native.threads())
    with kept.given(hash_grid=encoded_grad):  # values do not matter: it is asked for the gradient of the table
        encoded = hash_grid(unit, density.table, density.layout, density.deferred)
    known = (encoded_grad, *grads[0], *grads[1])
    return TracedError(_Known.apply(error, known, encoded, *networks[0], *networks[1]), rgb, int(samples))


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
    "traced_error", "ppppppqpipffppiifpppippipipi" "pipi" "pppq" "fq" "ppppp" "i", "q"
)
_take = native.Function("traced_error_take", "qppi")
