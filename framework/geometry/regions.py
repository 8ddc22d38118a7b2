"""Regions of space that edits and exports keep, and files of them.

A file of a region is YAML or JSON with a box or a sphere, in the frame and unit of exports:

    box: {low: [-1, -1, 0], high: [1, 1, 2]}

    box: {low: [-1, -1, 0], high: [1, 1, 2], axes: [[0.6, 0.8, 0], [-0.8, 0.6, 0], [0, 0, 1]]}

    sphere: {center: [0, 0, 1], radius: 2.5}
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TypeAlias

import torch
import yaml
from torch import Tensor

from nerfloom.base.arguments import arguments_of
from nerfloom.base.atomic import write_atomically
from nerfloom.base.errors import ConfigError
from nerfloom.base.plain import read_yaml, to_plain

Vector: TypeAlias = tuple[float, float, float]
"""Three coordinates."""
AXES: tuple[Vector, Vector, Vector] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
"""The axes of the frame."""
AXES_TOLERANCE = 1e-4
"""Largest error of the scalar products of a box's axes."""


@dataclass(frozen=True)
class Box:
    """A box, parallel to the axes of the frame or to axes of its own.

    Raises:
        ConfigError: if it has no volume, or its axes are not unit vectors at right angles.
    """

    low: Vector
    """Minimum corner: coordinates along `axes`."""
    high: Vector
    """Maximum corner: coordinates along `axes`."""
    axes: tuple[Vector, Vector, Vector] = AXES
    """Unit vectors along its edges."""

    def __post_init__(self) -> None:
        if not all(low < high for low, high in zip(self.low, self.high, strict=True)):
            raise ConfigError(
                f"the box from {self.low} to {self.high} is empty: each value of low must be below the value of high"
            )
        for row, first in enumerate(self.axes):
            for column, second in enumerate(self.axes):
                product = sum(a * b for a, b in zip(first, second, strict=True))
                if not abs(product - (row == column)) <= AXES_TOLERANCE:
                    raise ConfigError(f"the box's axes {self.axes} must be three unit vectors at right angles")

    def along(self, points: Tensor) -> Tensor:
        """Return the coordinates (N, 3) of `points` (N, 3), or of directions, along the axes of the box."""
        return (points[:, None, :] * points.new_tensor(self.axes)).sum(-1)  # no matmul: those may round (TF32)

    def contains(self, points: Tensor) -> Tensor:
        """Return whether `points` (N, 3) are in the box, (N,) bool; its faces belong to it."""
        found = self.along(points)
        return ((found >= points.new_tensor(self.low)) & (found <= points.new_tensor(self.high))).all(-1)

    def bounds(self) -> tuple[Vector, Vector]:
        """Return the minimum and the maximum corner of the smallest box around it that is parallel to the frame."""
        axes = torch.tensor(self.axes, dtype=torch.float64)
        sides = torch.cartesian_prod(*torch.tensor([self.low, self.high], dtype=torch.float64).T)
        corners = sides @ axes
        return _vector(corners.amin(0)), _vector(corners.amax(0))

    def grown(self, by: float) -> Box:
        """Return the box with each face moved outwards `by` a length."""
        (x0, y0, z0), (x1, y1, z1) = self.low, self.high
        return Box((x0 - by, y0 - by, z0 - by), (x1 + by, y1 + by, z1 + by), self.axes)

    def moved(self, rotation: Tensor, scale: float, shift: Tensor) -> Box:
        """Return the box after a similarity transform x -> scale * rotation @ x + shift.

        Args:
            rotation: (3, 3) rotation, float64, on the CPU.
            scale: factor of lengths.
            shift: (3,) shift, float64, on the CPU.
        """
        axes = torch.tensor(self.axes, dtype=torch.float64) @ rotation.T
        shifts = axes @ shift
        low, high = (scale * torch.tensor(corner, dtype=torch.float64) + shifts for corner in (self.low, self.high))
        first, second, third = map(_vector, axes)
        return Box(_vector(low), _vector(high), (first, second, third))


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

    def bounds(self) -> tuple[Vector, Vector]:
        """Return the minimum and the maximum corner of the box around it that is parallel to the frame."""
        (x, y, z), r = self.center, self.radius
        return (x - r, y - r, z - r), (x + r, y + r, z + r)

    def grown(self, by: float) -> Sphere:
        """Return the ball with a radius that is larger `by` a length."""
        return Sphere(self.center, self.radius + by)

    def moved(self, rotation: Tensor, scale: float, shift: Tensor) -> Sphere:
        """Return the ball after a similarity transform x -> scale * rotation @ x + shift.

        Args:
            rotation: (3, 3) rotation, float64, on the CPU.
            scale: factor of lengths.
            shift: (3,) shift, float64, on the CPU.
        """
        center = scale * (rotation @ torch.tensor(self.center, dtype=torch.float64)) + shift
        return Sphere(_vector(center), scale * self.radius)


Region: TypeAlias = Box | Sphere
"""A part of space."""
KINDS: dict[str, type[Box] | type[Sphere]] = {"box": Box, "sphere": Sphere}
"""Regions by their name in a file."""


def read_region(file: Path) -> Region:
    """Read a region from a `file`, YAML or JSON.

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


def write_region(file: Path, region: Region) -> None:
    """Write a `region` to a YAML `file` that `read_region` reads as the same one.

    Raises:
        OSError: if the file cannot be written.
    """
    (name,) = [name for name, kind in KINDS.items() if kind is type(region)]
    values = {each.name: (getattr(region, each.name), each.default) for each in fields(region)}
    content = {name: {key: to_plain(value) for key, (value, default) in values.items() if value != default}}
    text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None)
    write_atomically(file, lambda stream: stream.write(text.encode()))


def _vector(values: Tensor) -> Vector:
    x, y, z = values.tolist()
    return x, y, z


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


def bounds_of_all(regions: Sequence[Region]) -> tuple[Vector, Vector]:
    """Return the minimum and the maximum corner of a box around the intersection of some regions.

    Args:
        regions: at least one.

    Raises:
        ConfigError: if nothing is in all of them.
    """
    corners = torch.tensor([region.bounds() for region in regions], dtype=torch.float64)
    low, high = corners[:, 0].amax(0), corners[:, 1].amin(0)
    if not bool((low < high).all()):
        raise ConfigError("nothing is in all of the regions that are kept; they are in the frame and unit of exports")
    return _vector(low), _vector(high)
