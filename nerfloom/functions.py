"""Calls a user's functions of positions, and checks the rays that are given and the tensors that are returned.

A function is called with the positions alone where the rays have no times, and with the times behind them where they
have. Whatever else it needs (camera indices, lengths of intervals) it can take from the samples around it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from framework.fields.base import DensityFunction, Field
from framework.geometry.points import Points
from framework.geometry.rays import Rays, Samples

SigmaFunction = Callable[..., Tensor]
"""(positions (N, 3)[, times (N,)]) -> sigma (N,), density, at least 0, 1/length."""
RgbFunction = Callable[..., tuple[Tensor, Tensor] | tuple[Tensor, Tensor, Mapping[str, Tensor]]]
"""(positions (N, 3), unit directions (N, 3)[, times (N,)]) -> rgb (N, 3), sigma or alpha (N,)[, further properties by
name, each (N, ...)]."""
UNIT = 1e-3
"""By how much the length of a direction may differ from 1."""


class DensityOnly(Field):
    """Makes a function of positions a field without colour, for samplers, which ask for nothing but density.

    Args:
        sigma_fn: see `SigmaFunction`; None for a field that is empty everywhere.
    """

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
        raise NotImplementedError("samplers ask for density alone")


def as_density(sigma_fn: SigmaFunction) -> DensityFunction:
    """Wrap a user's function as samplers call it: with times or None, and with (empty) features beside the density.

    Args:
        sigma_fn: see `SigmaFunction`.
    Returns: a function whose density is float32, or float64 where it is that already. It raises ValueError where
        `sigma_fn` returns another shape than (N,).
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
    """Evaluate a user's function at N samples, gradients included.

    Args:
        function: see `RgbFunction`.
        what: the name of what it returns beside colours, for errors: "sigma" or "alpha".
        rays: whose samples these are. The positions have a gradient to them, with t held fixed.
        samples: where to evaluate.
    Returns: colours (N, 3), density or alpha (N,), and further properties (N, ...) by name.
    Raises: ValueError where a result is of another shape.
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
    """Check that a function has returned a tensor of the shape that it must have.

    Args:
        values: what was returned.
        shape: which it must have.
        what: which function returned what, for the error.
    Raises: ValueError that names `what`, both shapes, and what to do. A density of shape (N, 1) instead of (N,) would
        otherwise become one for each pair of samples, silently.
    """
    actual = tuple(values.shape) if isinstance(values, Tensor) else type(values).__name__
    if actual != shape:
        hint = ": squeeze its last dimension" if actual == (*shape, 1) else ""
        raise ValueError(f"{what} of shape {actual}; it must be a tensor of shape {shape}{hint}")


def check_rays(rays: Rays) -> None:
    """Check that rays are (R, 3) and their directions of length 1, so that t is a distance.

    Lengths are checked on a CPU only: elsewhere that would wait for the device.

    Args:
        rays: R rays.
    Raises: ValueError that names the first property that is wrong, or the ray whose direction is worst.
    """
    for name in ("origins", "directions"):
        shape = tuple(getattr(rays, name).shape)
        if len(shape) != 2 or shape[1] != 3 or shape[0] != len(rays):
            raise ValueError(f"the rays' {name} have shape {shape}; they must be (R, 3), as of tensor.reshape(-1, 3)")
    if rays.directions.device.type != "cpu" or not len(rays):
        return
    lengths = torch.linalg.vector_norm(rays.directions.detach(), dim=-1)
    worst = int((lengths - 1).abs().nan_to_num(0).argmax())
    length = lengths[worst].item()
    if abs(length - 1) > UNIT:
        raise ValueError(
            f"the direction of ray {worst} has length {length:.4g}; it must be 1, so that t is a distance: "
            "torch.nn.functional.normalize(directions, dim=-1)"
        )


def at_least_float32(values: Tensor) -> Tensor:
    """Convert values (N, ...) of lower precision to float32."""
    return values if values.dtype == torch.float64 else values.float()
