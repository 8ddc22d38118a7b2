"""Outputs: named values of a picture. A method declares outputs beyond the four that all methods have."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from nerfloom.kernels.math import safe_normalize

Kind = Literal["color", "opacity", "distance", "direction", "scalar"]


@dataclass(frozen=True)
class Output:
    """A named value of each pixel of a picture."""

    name: str
    """Name on the command line, in the viewer and in Python."""
    kind: Kind
    """color: red, green and blue in [0, 1]. opacity: a number in [0, 1]. distance: along the ray, scene units.
    direction: a unit vector in scene coordinates. scalar: any number. Directions and scalars of a pixel are means over
    its rays, as colours are; directions are normalised afterwards."""
    label: str = ""
    """Caption of its picture; the name if empty."""
    of_training: bool = False
    """Whether it exists for training images alone (`View.image`), such as content that only one of them has."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the value of one pixel."""
        return (3,) if self.kind in ("color", "direction") else ()

    def averaged(self, values: Tensor, rays_per_pixel: int) -> Tensor:
        """Return the value of each pixel from `values` (R, *shape) of `rays_per_pixel` consecutive rays."""
        return values if rays_per_pixel == 1 else values.view(-1, rays_per_pixel, *self.shape).mean(1)

    def finished(self, values: Tensor) -> Tensor:
        """Return `values` (P, *shape) of pixels in their final form: directions are normalised."""
        return safe_normalize(values.float()) if self.kind == "direction" else values.float()

    def pictured(self, values: Tensor) -> Tensor:
        """Return `values` (..., *shape) as colours or grey in [0, 1]; distances and scalars are unchanged."""
        return (values + 1) / 2 if self.kind == "direction" else values


RGB = Output("rgb", "color", "render")
DEPTH = Output("depth", "distance", "mean depth, scene units")
MEDIAN_DEPTH = Output("median_depth", "distance", "depth, scene units")
ACCUMULATION = Output("accumulation", "opacity", "opacity")
FIXED = RGB, DEPTH, MEDIAN_DEPTH, ACCUMULATION
"""Outputs of every method: fields of `Rendered`, `Pixels` and `Picture`."""
NORMALS = Output("normals", "direction")
"""Outward directions of surfaces."""
DIFFUSE = Output("diffuse", "color")
"""Light that leaves surfaces equally in all directions, in display colours over black."""


def empty(outputs: tuple[Output, ...], count: int, device: torch.device) -> dict[str, Tensor]:
    """Return zeros (count, *shape) on `device` for each of `outputs`, by name, for `count` pixels."""
    return {output.name: torch.zeros(count, *output.shape, device=device) for output in outputs}
