"""Samples of a signed distance, a first shape plus a network's output: opacity or density, and inputs of their colour.

With the outputs y and the gradient dy_0 / du of a network in the unit box (`distance.py`), u = (x - low) scale:

    f(x) = g(x) + b y_0
    n(x) = dg / dx + b scale dy_0 / du

The first shape g is the distance to a ball, |x - c| - r, or to a floor, m.x - h, whichever is smaller.

An interval along a ray stops light by NeuS's opacity, a point by VolSDF's density (`opacity.py`).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from nerfloom.kernels import native
from nerfloom.kernels.dispatch import CPP, TRITON, Operation
from nerfloom.kernels.math import safe_normalize
from nerfloom.kernels.surfaces.opacity import laplace_density, surface_opacity
from nerfloom.kernels.triton_backend import later

PLACED = 6
"""Number of features before the network's: gradient of the distance, and position in units of the box."""
NO_FLOOR = 0.0, 0.0, 0.0, -1e30
"""A floor that is farther from any position than any ball."""
SHORTEST = 1e-12
"""Minimum length of a gradient with a direction."""


class FirstShape(NamedTuple):
    """The distance that a network's output is added to: of a ball, and of a floor if there is one."""

    centre: Tensor
    """(3,) scene coordinates."""
    scale: Tensor
    """(3,) unit coordinates per scene unit."""
    size: float
    """Unit of the network's output, scene units."""
    radius: float
    """Radius of the ball, scene units."""
    rounding: float
    """Radius of smoothing around the centre, where the distance has no gradient, scene units."""
    floor: Tensor
    """(4,) unit normal m of the floor, upwards, and height h of the floor along it; `NO_FLOOR` for none."""


class Intervals(NamedTuple):
    """N intervals along rays, around their samples."""

    directions: Tensor
    """(N, 3) unit directions of their rays."""
    lengths: Tensor
    """(N,) lengths, scene units."""
    annealing: float = 1.0
    """Fraction of the slope's annealing that is done (`surface_opacity`)."""


def shape_distance(positions: Tensor, first: FirstShape) -> tuple[Tensor, Tensor]:
    """Return the distances (N,) of the first shape alone, and their gradients (N, 3), for any device and float type.

    Args:
        positions: (N, 3) scene coordinates.
        first: the shape.
    """
    offsets = positions - first.centre
    lengths = (offsets.square().sum(-1) + first.rounding**2).sqrt()
    normal = first.floor[:3]
    # Products and sums, because autocast would round a matrix product to bfloat16.
    heights = (positions * normal).sum(-1) - first.floor[3]
    lower = heights < lengths - first.radius
    distances = torch.where(lower, heights, lengths - first.radius)
    return distances, torch.where(lower[:, None], normal, offsets / lengths[:, None])


def first_distance(network: Tensor, positions: Tensor, first: FirstShape) -> tuple[Tensor, Tensor]:
    """Return the distances (N,) and their gradients (N, 3), for any device and float type.

    Args:
        network: (N, D + 3) outputs of a network, and the gradient of the first by the position in the unit box.
        positions: (N, 3) scene coordinates.
        first: the distance that the network's first output is added to.
    """
    distances, gradients = shape_distance(positions, first)
    return distances + first.size * network[:, 0], gradients + first.size * first.scale * network[:, -3:]


def surface_samples(
    network: Tensor, sharpness: Tensor, positions: Tensor, first: FirstShape, intervals: Intervals | None = None
) -> tuple[Tensor, Tensor]:
    """Return the opacity or density of samples, and the inputs of their colour.

    The compiled form has first derivatives by `network` and `sharpness`.

    Args:
        network: (N, D + 3) outputs of a network, and the gradient of the first by the position in the unit box.
        sharpness: () inverse width of the surface, 1/length.
        positions: (N, 3) scene coordinates of the samples.
        first: the distance that the network's first output is added to.
        intervals: the intervals around the samples; None for points.

    Returns:
        (N,) opacity of the intervals (NeuS, equation 13), or density at the points (VolSDF, equation 2), 1/length; and
        features (N, 6 + D - 1): gradient of the distance, position relative to the box, and the further outputs.
    """
    along = (None, None) if intervals is None else intervals[:2]
    return SURFACE_SAMPLES((network, sharpness, positions, *along), network, sharpness, positions, first, intervals)


def surface_samples_reference(
    network: Tensor, sharpness: Tensor, positions: Tensor, first: FirstShape, intervals: Intervals | None = None
) -> tuple[Tensor, Tensor]:
    """Compute `surface_samples` of `network`, `sharpness`, `positions`, `first` and `intervals` in PyTorch."""
    placed = (positions - first.centre) / first.size
    return stopped_samples(*first_distance(network, positions, first), network[:, 1:-3], placed, sharpness, intervals)


def stopped_samples(
    distances: Tensor, gradients: Tensor, features: Tensor, placed: Tensor, sharpness: Tensor,
    intervals: Intervals | None = None,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Return opacity or density at samples of any distance, and the inputs of their colour, as `surface_samples` does.

    Args:
        distances: (N,) signed distances at the samples, scene units.
        gradients: (N, 3) their gradients.
        features: (N, F) further inputs of the colour.
        placed: (N, 3) positions relative to the box.
        sharpness: () inverse width of the surface, 1/length.
        intervals: the intervals around the samples; None for points.
    """
    inputs = torch.cat([gradients, placed, features], dim=-1)
    if intervals is None:
        return laplace_density(distances, 1 / sharpness), inputs
    cosines = (gradients * intervals.directions).sum(-1)
    return surface_opacity(distances, cosines, intervals.lengths, sharpness, intervals.annealing), inputs


def unit_normals(features: Tensor) -> Tensor:
    """Return `features` (N, F) with the first three, the gradient of the distance, as a unit vector.

    The compiled form has first derivatives. A gradient shorter than 1e-12 becomes 0.
    """
    return UNIT_NORMALS((features,), features)


def unit_normals_reference(features: Tensor) -> Tensor:
    """Compute `unit_normals` of `features` in PyTorch, for any device and float type."""
    return torch.cat([safe_normalize(features[:, :3], SHORTEST), features[:, 3:]], dim=-1)


SURFACE_SAMPLES = Operation("surface_samples", surface_samples_reference)
UNIT_NORMALS = Operation("unit_normals", unit_normals_reference)
_samples = native.Function("surface_samples", "pqippppfppfffpppi")
_samples_backward = native.Function("surface_samples_backward", "pqippppfppfffpppppi")
_unit = native.Function("unit_normals", "pqifpi")
_unit_backward = native.Function("unit_normals_backward", "pqifppi")
SURFACE_SAMPLES.implementation(TRITON, differentiable=2)(later("surfaces.samples_triton", "surface_samples"))
UNIT_NORMALS.implementation(TRITON)(later("surfaces.samples_triton", "unit_normals"))


@SURFACE_SAMPLES.implementation(CPP, differentiable=2)
def _compiled(
    network: Tensor, sharpness: Tensor, positions: Tensor, first: FirstShape, intervals: Intervals | None = None
) -> tuple[Tensor, Tensor]:
    directions, lengths, annealing = intervals or (None, None, 1.0)
    rows = (None if each is None else each.contiguous() for each in (positions, directions, lengths))
    return _Samples.apply(first, annealing, network.contiguous(), sharpness, *rows)


class _Samples(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, first: FirstShape, annealing: float, network: Tensor, *rest: Any) -> tuple[Tensor, Tensor]:
        ctx.save_for_backward(network, *rest)
        ctx.first, ctx.annealing = first, annealing
        count, width = network.shape
        stopping, features = network.new_empty(count), network.new_empty(count, PLACED + width - 4)
        arguments = _arguments(first, annealing, network, *rest)
        _samples(*arguments, stopping.data_ptr(), features.data_ptr(), native.threads())
        ctx.set_materialize_grads(False)
        return stopping, features

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, of_stopping: Tensor | None, of_features: Tensor | None) -> tuple[Tensor | None, ...]:
        tensors = network, sharpness, *_ = ctx.saved_tensors
        of_stopping, of_features = (None if x is None else x.contiguous() for x in (of_stopping, of_features))
        of_network, of_sharpness, count = torch.empty_like(network), torch.zeros_like(sharpness), len(network)
        shapes = (count,), (count, PLACED + network.shape[1] - 4)
        _samples_backward(
            *_arguments(ctx.first, ctx.annealing, *tensors),
            None if of_stopping is None else native.pointer(of_stopping, "the gradient", shapes[0]),
            None if of_features is None else native.pointer(of_features, "the features' gradient", shapes[1]),
            of_network.data_ptr(), of_sharpness.data_ptr(), native.threads(),
        )  # fmt: skip
        return None, None, of_network, of_sharpness, None, None, None


def _arguments(
    first: FirstShape, annealing: float, network: Tensor, sharpness: Tensor, positions: Tensor,
    directions: Tensor | None, lengths: Tensor | None,
) -> tuple[Any, ...]:  # fmt: skip
    """Return the leading arguments that both compiled functions have."""
    count = len(network)
    return (
        native.pointer(network, "the network's output", (count, network.shape[1])), count, network.shape[1] - 3,
        native.pointer(positions, "positions", (count, 3)),
        None if directions is None else native.pointer(directions, "directions", (count, 3)),
        None if lengths is None else native.pointer(lengths, "lengths", (count,)),
        native.pointer(sharpness, "the sharpness", ()), annealing,
        native.pointer(first.centre, "the centre", (3,)), native.pointer(first.scale, "the scale", (3,)),
        first.size, first.radius, first.rounding, native.pointer(first.floor, "the floor", (4,)),
    )  # fmt: skip


@UNIT_NORMALS.implementation(CPP)
def _compiled_unit(features: Tensor) -> Tensor:
    return _UnitNormals.apply(features.contiguous())


class _UnitNormals(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, features: Tensor) -> Tensor:
        ctx.save_for_backward(features)
        out, (count, width) = torch.empty_like(features), features.shape
        address = native.pointer(features, "features", (count, width))
        _unit(address, count, width, SHORTEST, out.data_ptr(), native.threads())
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        (features,) = ctx.saved_tensors
        out, (count, width), grad = torch.empty_like(features), features.shape, grad.contiguous()
        address = native.pointer(grad, "the gradient", (count, width))
        _unit_backward(features.data_ptr(), count, width, SHORTEST, address, out.data_ptr(), native.threads())
        return out
