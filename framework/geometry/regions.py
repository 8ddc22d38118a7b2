"""Regions of space that edits and exports keep, and files of them.

A file of regions is YAML or JSON with a box, a sphere or a polygon, or a list of them, in the frame and unit of
exports:

    box: {low: [-1, -1, 0], high: [1, 1, 2]}

    box: {low: [-1, -1, 0], high: [1, 1, 2], axes: [[0.6, 0.8, 0], [-0.8, 0.6, 0], [0, 0, 1]]}

    polygon: {position: [0, 0, 9], axes: [[1, 0, 0], [0, 1, 0], [0, 0, 1]], corners: [[0, 0], [0.1, 0], [0, 0.1]]}

    regions:
      - sphere: {center: [0, 0, 1], radius: 2.5}
      - box: {low: [-1, -1, 0], high: [1, 1, 2]}
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, TypeAlias

import torch
import yaml
from torch import Tensor

from nerfloom.base.arguments import arguments_of
from nerfloom.base.atomic import write_atomically
from nerfloom.base.errors import ConfigError, shown
from nerfloom.base.plain import read_yaml, to_plain
from nerfloom.geometry.lenses import DISTORTED, LENSES, Distortion, project

Vector: TypeAlias = tuple[float, float, float]
"""Three coordinates."""
Axes: TypeAlias = tuple[Vector, Vector, Vector]
"""Three unit vectors at right angles."""
Place: TypeAlias = tuple[float, float]
"""Two coordinates on a plane, x to the right and y down."""
AXES: Axes = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
"""The axes of the frame."""
AXES_TOLERANCE, POSE_TOLERANCE = 1e-4, 1e-3
"""Largest errors of the scalar products of a box's axes, and of a camera's, which files may round."""
EVERYWHERE: tuple[Vector, Vector] = ((-math.inf,) * 3, (math.inf,) * 3)
"""Minimum and maximum corner of all of space."""


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
    axes: Axes = AXES
    """Unit vectors along its edges."""

    def __post_init__(self) -> None:
        if not all(low < high for low, high in zip(self.low, self.high, strict=True)):
            raise ConfigError(
                f"the box from {self.low} to {self.high} is empty: each value of low must be below the value of high"
            )
        _check_axes(self.axes, AXES_TOLERANCE, "the box's")

    def along(self, points: Tensor) -> Tensor:
        """Return the coordinates (N, 3) of `points` (N, 3), or of directions, along the axes of the box."""
        return _along(points, self.axes)

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
        return Box(_vector(low), _vector(high), axes_of(axes))


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


@dataclass(frozen=True)
class Polygon:
    """Part of space that a view shows in a polygon, at any distance from its camera, or all the rest.

    Raises:
        ConfigError: if it has fewer than three corners, its camera's axes are not unit vectors at right angles, or its
            lens is none of `nerfloom.geometry.lenses`.
    """

    position: Vector
    """Position of the camera."""
    axes: Axes
    """Directions of the camera: right, up and back, as in OpenGL."""
    corners: tuple[Place, ...]
    """Corners in order, in normalised image coordinates: pixels from the principal point over the focal length, x to
    the right and y down. A position is inside if a line from it to the right crosses the edges an odd number of
    times."""
    keep: bool = True
    """False for the rest: what the view shows beside the polygon, and what it does not show."""
    model: str = "pinhole"
    """Projection of the camera, a key of `LENSES`."""
    lens: tuple[float, ...] = ()
    """Distortion coefficients, in the order of `LENSES[model]`; empty if all are zero."""

    def __post_init__(self) -> None:
        if len(self.corners) < 3:
            raise ConfigError(f"a polygon has at least 3 corners, not {len(self.corners)}")
        _check_axes(self.axes, POSE_TOLERANCE, "the polygon's")
        if self.model not in LENSES:
            raise ConfigError(f"the polygon's model is {shown(self.model)}; it must be one of {', '.join(LENSES)}")
        if len(self.lens) not in (0, len(LENSES[self.model])):
            count = len(LENSES[self.model])
            raise ConfigError(f"the polygon's lens has {len(self.lens)} coefficients; {self.model} has {count}")

    def contains(self, points: Tensor) -> Tensor:
        """Return whether `points` (N, 3) are in the region, (N,) bool.

        The camera sees no point behind it, nor one beyond the reach of its lens; these count as outside of the polygon.
        """
        lens = None
        if self.model in DISTORTED:
            values = self.lens or (0.0,) * len(LENSES[self.model])
            lens = Distortion.of(self.model, torch.tensor([values], dtype=torch.float64)).to(points)
        x, y, is_seen = project(self.model, self._local(points), lens)
        return (is_seen & inside_polygon(x, y, self.corners)) == self.keep

    def crossings(self, origins: Tensor, directions: Tensor) -> Tensor:
        """Return where rays meet the planes through the camera and an edge, and the plane at right angles to its view.

        Between two of these distances, a ray is in the region or outside.

        Args:
            origins, directions: (R, 3).

        Returns:
            (R, C + 1) distances for C corners, in no order; those behind the origin are negative, and those of a
            parallel plane infinite or NaN.

        Raises:
            ValueError: if the camera is no pinhole, so that its edges are in no planes.
        """
        if self.model != "pinhole":
            raise ValueError(f"a polygon of a camera of the model {self.model} has no planes")
        corners = [torch.tensor((*corner, 1.0), dtype=torch.float64) for corner in self.corners]
        pairs = zip(corners, (*corners[1:], corners[0]), strict=True)
        normals = torch.stack([*(torch.linalg.cross(*pair) for pair in pairs), torch.tensor((0.0, 0.0, 1.0)).double()])
        turned = (normals * normals.new_tensor((1.0, -1.0, -1.0))).to(origins)  # from x, down, ahead to OpenGL's axes
        starts, steps = (
            (vectors[:, None, :] * turned).sum(-1) for vectors in (self._local(origins), _along(directions, self.axes))
        )
        return -starts / steps

    def _local(self, points: Tensor) -> Tensor:
        """Return `points` (N, 3) in the camera's frame."""
        return _along(points - points.new_tensor(self.position), self.axes)

    def bounds(self) -> tuple[Vector, Vector]:
        """Return the corners of all of space: a view has no end."""
        return EVERYWHERE

    def grown(self, by: float) -> Polygon:
        """Return the polygon itself, whatever `by` is: vertices of a mesh lie on its sides by chance alone."""
        return self

    def moved(self, rotation: Tensor, scale: float, shift: Tensor) -> Polygon:
        """Return the region after a similarity transform x -> scale * rotation @ x + shift.

        Args:
            rotation: (3, 3) rotation, float64, on the CPU.
            scale: factor of lengths.
            shift: (3,) shift, float64, on the CPU.
        """
        axes = torch.tensor(self.axes, dtype=torch.float64) @ rotation.T
        position = scale * (rotation @ torch.tensor(self.position, dtype=torch.float64)) + shift
        on_plane = scale if self.model == "orthographic" else 1.0  # its image coordinates are lengths
        corners = tuple((on_plane * x, on_plane * y) for x, y in self.corners)
        return replace(self, position=_vector(position), axes=axes_of(axes), corners=corners)


Region: TypeAlias = Box | Sphere | Polygon
"""A part of space."""
KINDS: dict[str, type[Box] | type[Sphere] | type[Polygon]] = {"box": Box, "sphere": Sphere, "polygon": Polygon}
"""Regions by their name in a file."""
SEVERAL = "regions"
"""Name of a list of regions in a file."""


def read_regions(file: Path) -> list[Region]:
    """Read the regions of a `file`, YAML or JSON; their intersection is meant.

    Raises:
        ConfigError: if the file cannot be read, or holds no region.
    """
    content = read_yaml(file)
    rows = content[SEVERAL] if content.keys() == {SEVERAL} else [content]
    found: list[Region] = []
    for row in rows if isinstance(rows, list) else ():
        if not isinstance(row, dict) or len(row) != 1 or not row.keys() <= KINDS.keys():
            found.clear()
            break
        ((name, values),) = row.items()
        where = f"{file}: {name}" if rows == [content] else f"{file}: region {len(found) + 1} ({name})"
        found.append(KINDS[name](**arguments_of(KINDS[name], values, where)))
    if not found:
        raise ConfigError(
            f"{file} must hold a box, a sphere or a polygon alone, such as 'sphere: {{center: [0, 0, 0], radius: 1}}', "
            f"or a list of them, '{SEVERAL}'"
        )
    return found


def write_regions(file: Path, regions: Sequence[Region]) -> None:
    """Write one or more `regions` to a YAML `file` that `read_regions` reads as the same ones.

    Raises:
        OSError: if the file cannot be written.
    """
    rows = [_plain(region) for region in regions]
    content = rows[0] if len(rows) == 1 else {SEVERAL: rows}
    text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None)
    write_atomically(file, lambda stream: stream.write(text.encode()))


def _plain(region: Region) -> dict[str, Any]:
    """Return a region as a name and plain values, without those that are the default."""
    (name,) = [name for name, kind in KINDS.items() if kind is type(region)]
    values = {each.name: (getattr(region, each.name), each.default) for each in fields(region)}
    return {name: {key: to_plain(value) for key, (value, default) in values.items() if value != default}}


def inside_polygon(x: Tensor, y: Tensor, corners: Sequence[Place]) -> Tensor:
    """Return which positions are inside a polygon, (N,) bool, by the number of edges to their right (even-odd rule).

    Args:
        x, y: (N,) positions.
        corners: the corners, in order.
    """
    inside = torch.zeros_like(x, dtype=torch.bool)
    for (x0, y0), (x1, y1) in zip(corners, (*corners[1:], corners[0]), strict=True):
        if y0 != y1:
            crosses = (y0 > y) != (y1 > y)
            inside ^= crosses & (x < x0 + (x1 - x0) * (y - y0) / (y1 - y0))
    return inside


def axes_of(rows: Tensor) -> Axes:
    """Return the `rows` (3, 3) of a matrix as axes."""
    first, second, third = map(_vector, rows)
    return first, second, third


def _check_axes(axes: Axes, tolerance: float, owner: str) -> None:
    """Refuse axes that are not unit vectors at right angles; `owner` is for the message."""
    for row, first in enumerate(axes):
        for column, second in enumerate(axes):
            product = sum(a * b for a, b in zip(first, second, strict=True))
            if not abs(product - (row == column)) <= tolerance:
                raise ConfigError(f"{owner} axes {axes} must be three unit vectors at right angles")


def _along(vectors: Tensor, axes: Axes) -> Tensor:
    """Return the coordinates (N, 3) of `vectors` (N, 3) along some axes."""
    return (vectors[:, None, :] * vectors.new_tensor(axes)).sum(-1)  # no matmul: those may round (TF32)


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


def bounds_of_all(regions: Sequence[Region]) -> tuple[Vector, Vector] | None:
    """Return the minimum and the maximum corner of a box around the intersection of `regions`; None if unbounded.

    Raises:
        ConfigError: if nothing is in all of them.
    """
    corners = torch.tensor([EVERYWHERE, *(region.bounds() for region in regions)], dtype=torch.float64)
    low, high = corners[:, 0].amax(0), corners[:, 1].amin(0)
    if not bool((low < high).all()):
        raise ConfigError("nothing is in all of the regions that are kept; they are in the frame and unit of exports")
    return (_vector(low), _vector(high)) if bool((low.isfinite() & high.isfinite()).all()) else None
