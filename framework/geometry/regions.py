"""Regions of space that edits and exports keep, and files of them.

A file of a region is YAML or JSON with a box or a sphere, in the frame and unit of exports:

    box: {low: [-1, -1, 0], high: [1, 1, 2]}

    sphere: {center: [0, 0, 1], radius: 2.5}
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import torch
from torch import Tensor

from nerfloom.base.arguments import arguments_of
from nerfloom.base.errors import ConfigError
from nerfloom.base.plain import read_yaml

Vector: TypeAlias = tuple[float, float, float]
"""Three coordinates."""


@dataclass(frozen=True)
class Box:
    """A box parallel to the axes.

    Raises:
        ConfigError: if it has no volume.
    """

    low: Vector
    """Minimum corner."""
    high: Vector
    """Maximum corner."""

    def __post_init__(self) -> None:
        if not all(low < high for low, high in zip(self.low, self.high, strict=True)):
            raise ConfigError(
                f"the box from {self.low} to {self.high} is empty: each of low must be below that of high"
            )

    def contains(self, points: Tensor) -> Tensor:
        """Return whether `points` (N, 3) are in the box, (N,) bool; its faces belong to it."""
        return ((points >= points.new_tensor(self.low)) & (points <= points.new_tensor(self.high))).all(-1)


@dataclass(frozen=True)
class Sphere:
    """A ball.

    Raises:
        ConfigError: if its radius is not positive.
    """

    center: Vector
    """Centre."""
    radius: float
    """Radius."""

    def __post_init__(self) -> None:
        if not self.radius > 0:
            raise ConfigError(f"the sphere's radius is {self.radius:g}; it must be above 0")

    def contains(self, points: Tensor) -> Tensor:
        """Return whether `points` (N, 3) are in the ball, (N,) bool; its surface belongs to it."""
        return (points - points.new_tensor(self.center)).norm(dim=-1) <= self.radius


Region: TypeAlias = Box | Sphere
"""A part of space."""
KINDS: dict[str, type[Box] | type[Sphere]] = {"box": Box, "sphere": Sphere}
"""Regions by their name in a file."""


def read_region(file: Path) -> Region:
    """Read a region.

    Args:
        file: path of the file, YAML or JSON.

    Raises:
        ConfigError: if the file cannot be read, or holds no region.
    """
    content = read_yaml(file)
    if len(content) != 1 or not content.keys() <= KINDS.keys():
        raise ConfigError(
            f"{file} must hold a box or a sphere alone, such as 'sphere: {{center: [0, 0, 0], radius: 1}}'"
        )
    ((name, values),) = content.items()
    return KINDS[name](**arguments_of(KINDS[name], values, f"{file}: {name}"))


def inside_all(points: Tensor, regions: Sequence[Region]) -> Tensor:
    """Return which points are in all of some regions, (N,) bool.

    Args:
        points: (N, 3) positions, in the frame and unit of the regions.
        regions: the regions; none for all of space.

    Raises:
        ConfigError: if no point is.
    """
    inside = torch.ones(len(points), dtype=torch.bool, device=points.device)
    for region in regions:
        inside &= region.contains(points)
    if not bool(inside.any()):
        raise ConfigError("nothing is in the region that is kept; it is in the frame and unit of exports")
    return inside
