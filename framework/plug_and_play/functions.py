"""Calls of user-defined functions of positions, with checks of the rays and of the returned tensors.

A function is called with positions, and with times if the rays have times. It can take other inputs (camera indices,
interval lengths) from the samples in its enclosing scope.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from nerfloom.fields.base import DensityFunction, Field
from nerfloom.geometry.points import Points
from nerfloom.geometry.rays import Rays, Samples
from nerfloom.kernels.math import at_least_float32

SigmaFunction = Callable[..., Tensor]
"""Function (positions (N, 3)[, times (N,)]) -> sigma (N,), the density in 1/length, at least 0."""
RgbFunction = Callable[..., tuple[Tensor, Tensor] | tuple[Tensor, Tensor, Mapping[str, Tensor]]]
"""Function (positions (N, 3), unit directions (N, 3)[, times (N,)]) -> rgb (N, 3), sigma or alpha (N,)[, further
properties by name, each (N, ...)]."""
UNIT_TOLERANCE = 1e-3
"""Maximum deviation of the length of a direction from 1."""


class DensityOnly(Field):
    """A field of density from a user's `sigma_fn`, or empty everywhere if that is None, for samplers."""

    def __init__(self, sigma_fn: SigmaFunction | None) -> None:
        super().__init__()
        self.sigma_fn = sigma_fn

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        if self.sigma_fn is None:
            sigma = points.positions.new_zeros(len(points))
        else:
            sigma = as_density(self.sigma_fn)(points)[0]
        return sigma, sigma[:, None]

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        raise NotImplementedError("a density function has no colours")


def as_density(sigma_fn: SigmaFunction) -> DensityFunction:
    """Wrap a user-defined function for samplers, with empty features in addition to the density.

    Args:
        sigma_fn: a `SigmaFunction`.

    Returns:
        A function that returns float64 densities if `sigma_fn` does, and float32 otherwise. It raises ValueError if
        `sigma_fn` returns a shape other than (N,).
    """

    def density(points: Points) -> tuple[Tensor, Tensor]:
        positions, times = points.positions, points.times
        sigma = sigma_fn(positions) if times is None else sigma_fn(positions, times)
        check_shape(sigma, (len(positions),), "sigma_fn returned density")
        return at_least_float32(sigma), positions[:, :0]

    return density


def evaluate(
    function: RgbFunction, what: str, rays: Rays, samples: Samples
) -> tuple[Tensor, Tensor, Mapping[str, Tensor]]:
    """Evaluate a user-defined function at samples, gradients included.

    Args:
        function: an `RgbFunction`.
        what: name of the second value that it returns, for errors: "sigma" or "alpha".
        rays: R rays. Gradients of the positions flow to the rays, with t held fixed.
        samples: N samples along the rays.

    Returns:
        colours (N, 3), density or alpha (N,), and further properties (N, ...) by name.

    Raises:
        ValueError: if a returned value has another shape.
    """
    times = samples.times(rays)
    arguments = samples.positions(rays), rays.directions.index_select(0, samples.ray_indices)
    rgb, values, *rest = function(*arguments) if times is None else function(*arguments, times)
    extras: Mapping[str, Tensor] = rest[0] if rest else {}
    check_shape(rgb, (len(samples), 3), f"rgb_{what}_fn returned rgb")
    check_shape(values, (len(samples),), f"rgb_{what}_fn returned {what}")
    for name, property_ in extras.items():
        shape = (len(samples), *getattr(property_, "shape", ())[1:])
        check_shape(property_, shape, f"rgb_{what}_fn returned {name}")
    return rgb, values, extras


def check_shape(values: Any, shape: tuple[int, ...], what: str) -> None:
    """Check that a function returned a tensor of the required shape.

    A density of shape (N, 1) instead of (N,) would otherwise be broadcast to one value for each pair of samples.

    Args:
        values: the returned value.
        shape: the required shape.
        what: name of the function and the value for the error, such as "sigma_fn returned density".

    Raises:
        ValueError: if the value is not a tensor or has another shape.
    """
    actual = tuple(values.shape) if isinstance(values, Tensor) else type(values).__name__
    if actual != shape:
        hint = ": squeeze its last dimension" if actual == (*shape, 1) else ""
        raise ValueError(f"{what} of shape {actual}; it must be a tensor of shape {shape}{hint}")


def check_rays(rays: Rays) -> None:
    """Check that the origins and directions of `rays` are (R, 3) and the directions have length 1.

    Lengths are checked on the CPU only, because on other devices the check would wait for the device.

    Raises:
        ValueError: if a shape is wrong, or the length of a direction is not 1.
    """
    for name in ("origins", "directions"):
        shape = tuple(getattr(rays, name).shape)
        if len(shape) != 2 or shape[1] != 3 or shape[0] != len(rays):
            raise ValueError(f"the rays' {name} have shape {shape}; they must be (R, 3): use tensor.reshape(-1, 3)")
    if rays.directions.device.type != "cpu" or not len(rays):
        return
    lengths = torch.linalg.vector_norm(rays.directions.detach(), dim=-1)
    worst = int((lengths - 1).abs().nan_to_num(0).argmax())
    length = lengths[worst].item()
    if abs(length - 1) > UNIT_TOLERANCE:
        raise ValueError(
            f"the direction of ray {worst} has length {length:.4g}; it must be 1, so that t is a distance: use "
            "torch.nn.functional.normalize(directions, dim=-1)"
        )
