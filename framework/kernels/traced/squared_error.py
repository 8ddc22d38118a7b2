"""The squared error of traced rays' colours, and its gradient, in one compiled call.

The readable form (`traced_error_reference`) traces rays, evaluates the colour network, composites, and takes the mean
square. If the loss is this mean alone, its gradient is known as soon as the colours are. The compiled form processes a
block of rays forward and backward in cache, and keeps the networks' activations for the backward pass
(`kernels/traced/squared_error.cpp`).

Most samples have almost no gradient: they lie in space that is already empty, or behind a surface. The compiled form
can skip most of these (`thin`). A sample with a gradient of a fraction p < 1 of a threshold is kept with probability p,
and its gradient is then multiplied by 1 / p. The expectation of the sum is unchanged, as in Russian roulette of light
paths (Arvo and Kirk 1990, "Particle transport and image synthesis").
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from nerfloom.kernels import native, result_cache
from nerfloom.kernels.dispatch import CPP, Operation
from nerfloom.kernels.grids.hash_grid import hash_grid
from nerfloom.kernels.known_gradient import KnownGradient
from nerfloom.kernels.march.waves import March
from nerfloom.kernels.networks.mlp import multiplies_bf16
from nerfloom.kernels.traced.colors import GridColor, has_compiled_networks, traced_colors_reference
from nerfloom.kernels.traced.trace import DENSITY, PATH, GridDensity, arguments, network_arguments

MAX_RAYS = 256
"""Maximum number of rays per pixel in the compiled form."""


class TracedError(NamedTuple):
    """The error of P pixels."""

    error: Tensor
    """() mean of weight * (colour - target)^2, with its gradient."""
    rgb: Tensor
    """(P, 3) colours, without gradient."""
    num_samples: int
    """Number of samples that light reached."""


class PixelTargets(NamedTuple):
    """Colours of P pixels, each the mean of R / P consecutive rays."""

    background: Tensor
    """(R, 3) colour behind each ray."""
    target: Tensor
    """(P, 3) true colours."""
    weights: Tensor | None = None
    """(P,) factors of the pixels; None for 1."""


def traced_error(
    marched: March, density: GridDensity, color: GridColor, pixels: PixelTargets, thin: float = 0.0
) -> TracedError:
    """Return the mean squared error of the colours of traced rays.

    Args:
        marched: the march of R rays, before its first wave; the rays get no gradient.
        density: the density along the rays.
        color: the colour along the rays.
        pixels: target colours.
        thin: samples with gradients below this factor times a mean (over samples of some dozen rays) are skipped at
            random; 0 skips none. The reference skips none.
    """
    tensors = (marched.rays.origins, density.table, *density.weights, *color.weights, *pixels)
    return TRACED_ERROR(tensors, marched, density, color, pixels, thin)


def traced_error_reference(
    marched: March, density: GridDensity, color: GridColor, pixels: PixelTargets, thin: float = 0.0
) -> TracedError:
    """Compute `traced_error` in PyTorch and single operations, on any device.

    `marched`, `density`, `color` and `pixels` are as in `traced_error`; `thin` is not used.
    """
    shown = traced_colors_reference(marched, density, color, pixels.background)
    rendered = shown.color.view(len(pixels.target), -1, 3).mean(1)
    squares = (rendered - pixels.target).square()
    error = squares if pixels.weights is None else squares * pixels.weights[:, None]
    return TracedError(error.mean(), rendered.detach(), shown.num_samples)


TRACED_ERROR = Operation("traced_error", traced_error_reference)


def _fits(marched: March, density: GridDensity, color: GridColor, pixels: PixelTargets, thin: float = 0.0) -> bool:
    """Return whether all single operations would run compiled, with gradients for table and weights only."""
    if not torch.is_grad_enabled() or any(tensor is not None and tensor.requires_grad for tensor in pixels):
        return False
    if not 0 < len(marched.rays) <= MAX_RAYS * len(pixels.target):
        return False
    return has_compiled_networks(marched, density, color)


@TRACED_ERROR.implementation(CPP, fits=_fits)
def _compiled(
    marched: March, density: GridDensity, color: GridColor, pixels: PixelTargets, thin: float = 0.0
) -> TracedError:
    background, target, weights = (None if tensor is None else tensor.contiguous() for tensor in pixels)
    assert background is not None
    assert target is not None
    rays, count = len(marched.rays), len(target)
    rgb, error, samples = torch.empty(count, 3), torch.empty(()), torch.empty(1, dtype=torch.int64)
    networks = [density.weights, color.weights]
    grads = [[torch.empty_like(weight) for weight in each] for each in networks]
    seed = int(torch.randint(2**62, ())) if thin else 0
    total = _traced_error(
        *arguments(marched, density), multiplies_bf16(), *network_arguments(color.weights), color.bands,
        native.pointer(background, "the background", (rays, 3)), native.pointer(target, "the target", (count, 3)),
        None if weights is None else native.pointer(weights, "the pixels' weights", (count,)), rays // count,
        thin, seed, rgb.data_ptr(), error.data_ptr(),
        *(native.pointers([grad.data_ptr() for grad in each]) for each in grads), samples.data_ptr(), native.threads(),
    )  # fmt: skip
    unit, by_encoded = torch.empty(total, 3), torch.empty(total, density.weights[0].shape[1])
    _take(total, unit.data_ptr(), by_encoded.data_ptr(), native.threads())
    with result_cache.given(hash_grid=by_encoded):  # the values do not matter, only the table's gradient
        encoded = hash_grid(unit, density.table, density.layout, density.deferred)
    computed = (error, by_encoded, *grads[0], *grads[1])
    return TracedError(KnownGradient.apply(computed, encoded, *networks[0], *networks[1]), rgb, int(samples))


_traced_error: Callable[..., int] = native.Function("traced_error", PATH + DENSITY + "ipipipppqfqpppppi", "q")
_take = native.Function("traced_error_take", "qppi")
