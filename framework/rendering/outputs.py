"""Outputs: what a picture shows, by name. A method declares those that it has beside the four that all have."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from nerfloom.kernels.math import safe_normalize

Kind = Literal["color", "opacity", "distance", "direction", "scalar"]


@dataclass(frozen=True)
class Output:
    """Something that a picture shows."""

    name: str
    """Name on the command line, in the viewer and in Python."""
    kind: Kind
    """color: red, green and blue in [0, 1]. opacity: a number in [0, 1]. distance: along the ray, scene units.
    direction: a unit vector in scene coordinates. scalar: any number. The last two are means over the rays of a pixel,
    as colours are; a direction is normalised afterwards."""
    label: str = ""
    """Words above its picture; the name if empty."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the value of one pixel."""
        return (3,) if self.kind in ("color", "direction") else ()

    def averaged(self, values: Tensor, rays_per_pixel: int) -> Tensor:
        """Return the value of each pixel, from those of its rays.

        Args:
            values: (R, *shape) values of rays, those of a pixel one after the other.
            rays_per_pixel: number of rays of a pixel.
        """
        return values if rays_per_pixel == 1 else values.view(-1, rays_per_pixel, *self.shape).mean(1)

    def finished(self, values: Tensor) -> Tensor:
        """Return values (P, *shape) of pixels as a picture holds them: directions with unit length.

        Args:
            values: values of pixels.
        """
        return safe_normalize(values.float()) if self.kind == "direction" else values.float()

    def pictured(self, values: Tensor) -> Tensor:
        """Return values (..., *shape) as colours or a grey in [0, 1]; of a distance or a scalar as they are.

        Args:
            values: values of pixels.
        """
        return (values + 1) / 2 if self.kind == "direction" else values


RGB = Output("rgb", "color", "render")
DEPTH = Output("depth", "distance", "mean depth, scene units")
MEDIAN_DEPTH = Output("median_depth", "distance", "depth, scene units")
ACCUMULATION = Output("accumulation", "opacity", "opacity")
FIXED = RGB, DEPTH, MEDIAN_DEPTH, ACCUMULATION
"""Outputs of every method, which are fields of `Rendered`, `Pixels` and `Picture`."""
NORMALS = Output("normals", "direction")
"""Directions of surfaces, pointing away from them."""


def empty(outputs: tuple[Output, ...], count: int, device: torch.device) -> dict[str, Tensor]:
    """Return zeros (count, *shape) for outputs, by name.

    Args:
        outputs: the outputs.
        count: number of pixels.
        device: device of the result.
    """
    return {output.name: torch.zeros(count, *output.shape, device=device) for output in outputs}
