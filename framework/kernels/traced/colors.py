"""Rendering of traced rays in one compiled call, if no gradient is needed.

The readable form traces rays, evaluates the colour network and composites. The compiled one takes a block of rays
through all of that while it is in cache (`squared_error.cpp`), so that no sample is ever written to memory.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from nerfloom.geometry.rays import Samples
from nerfloom.kernels import native
from nerfloom.kernels.compositing.density import composite
from nerfloom.kernels.dispatch import CPP, Operation
from nerfloom.kernels.encodings.spherical_harmonics import spherical_harmonics
from nerfloom.kernels.march.waves import March
from nerfloom.kernels.math import at_least_float32
from nerfloom.kernels.networks.mlp import NETWORK, mlp, multiplies_bf16
from nerfloom.kernels.traced.trace import DENSITY, PATH, GridDensity, arguments, is_compiled, network_arguments, trace


@dataclass(frozen=True)
class GridColor:
    """A colour: the sigmoid of `mlp` of the outputs of a `GridDensity` and of harmonics of the viewing direction."""

    bands: int
    """Bands of the harmonics; 0 for colours that do not depend on the direction."""
    weights: Sequence[Tensor]
    """(D_out, D_in) weights of each layer, without biases."""


class TracedColors(NamedTuple):
    """Rendered values of R rays."""

    color: Tensor
    """(R, 3) colour over the background."""
    opacity: Tensor
    """(R,) sum of the weights."""
    moment: Tensor
    """(R,) sum of weight * t."""
    median: Tensor
    """(R,) t of the first sample with a transmittance of at most 0.5 behind it, or the far end."""
    num_samples: int
    """Number of samples that light reached."""


def traced_colors(marched: March, density: GridDensity, color: GridColor, background: Tensor) -> TracedColors:
    """Return the colours and depths of traced rays.

    Args:
        marched: the march of R rays, before its first wave; the rays get no gradient.
        density: the density along the rays.
        color: the colour along the rays.
        background: (R, 3) colour behind each ray.
    """
    tensors = (marched.rays.origins, density.table, *density.weights, *color.weights, background)
    return TRACED_COLORS(tensors, marched, density, color, background)


def traced_colors_reference(marched: March, density: GridDensity, color: GridColor, background: Tensor) -> TracedColors:
    """Compute `traced_colors` of `marched`, `density`, `color` and `background` in PyTorch, in single operations."""
    traced, rays = trace(marched, density), marched.rays
    inputs = [traced.features]
    if color.bands:
        inputs.append(spherical_harmonics(rays.directions.index_select(0, traced.owners), color.bands))
    rgb = at_least_float32(mlp(inputs, color.weights, "sigmoid"))
    samples = Samples(traced.t_starts, traced.t_ends, traced.offsets, owners=traced.owners, longest=traced.longest)
    sums = composite(samples, traced.sigma, rgb, background, rays.fars)
    return TracedColors(sums.color, sums.opacity, sums.moment, sums.median, len(samples))


TRACED_COLORS = Operation("traced_colors", traced_colors_reference)


def has_compiled_networks(marched: March, density: GridDensity, color: GridColor) -> bool:
    """Return whether march, hash grid and both networks run compiled, with the required derivatives.

    Args:
        marched: the march, before its first wave.
        density: the density along its rays.
        color: the colour along its rays.
    """
    if not is_compiled(marched, density):
        return False
    inputs = (marched.rays.origins,)
    network = NETWORK.choose((*inputs, *color.weights), inputs, color.weights, "sigmoid")
    return network.backend is CPP and all(weight.is_contiguous() for weight in color.weights)


def _fits(marched: March, density: GridDensity, color: GridColor, background: Tensor) -> bool:
    return not torch.is_grad_enabled() and has_compiled_networks(marched, density, color)


@TRACED_COLORS.implementation(CPP, order=0, fits=_fits)
def _compiled(marched: March, density: GridDensity, color: GridColor, background: Tensor) -> TracedColors:
    rays, behind, fars = len(marched.rays), background.contiguous(), marched.rays.fars.contiguous()
    rgb, (opacity, moment, median) = torch.empty(rays, 3), (torch.empty(rays) for _ in range(3))
    samples = _traced_colors(
        *arguments(marched, density), multiplies_bf16(), *network_arguments(color.weights), color.bands,
        native.pointer(behind, "the background", (rays, 3)), native.pointer(fars, "far ends", (rays,)),
        rgb.data_ptr(), opacity.data_ptr(), moment.data_ptr(), median.data_ptr(), native.threads(),
    )  # fmt: skip
    return TracedColors(rgb, opacity, moment, median, samples)


_traced_colors: Callable[..., int] = native.Function("traced_colors", PATH + DENSITY + "ipipippppppi", "q")
