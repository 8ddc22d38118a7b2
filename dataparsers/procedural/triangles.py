"""Exact surfaces of solids as triangles: vertices on the surface, with its normals.

Flat faces are exact, and their corners have a vertex for each face that meets there, so that edges are sharp. Curved
faces are divided so finely that no point of a triangle is farther from them than a given deviation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from nerfloom.dataparsers.procedural.shapes import BoredBox, Box, Sphere, Torus


class Triangles(NamedTuple):
    """A closed surface."""

    vertices: Tensor
    """(V, 3) float64 positions on the surface."""
    normals: Tensor
    """(V, 3) float64 outward unit normals."""
    faces: Tensor
    """(F, 3) int64 vertices, counterclockwise seen from outside."""


def joined(parts: Sequence[Triangles]) -> Triangles:
    """Return the surfaces `parts` as one."""
    starts = torch.tensor([0, *(len(part.vertices) for part in parts)]).cumsum(0)
    faces = [part.faces + start for part, start in zip(parts, starts, strict=False)]
    return Triangles(torch.cat([p.vertices for p in parts]), torch.cat([p.normals for p in parts]), torch.cat(faces))


def of_sphere(shape: Sphere, deviation: float) -> Triangles:
    """Return the surface of the ball `shape` as a grid of latitudes and longitudes, at most `deviation` from it."""
    count = 2 * _divisions(shape.radius, deviation / 2)
    latitude = torch.linspace(-math.pi / 2, math.pi / 2, count // 2 + 1, dtype=torch.float64)
    longitude = _angles(count)
    ring = torch.stack([longitude.cos(), longitude.sin(), torch.zeros_like(longitude)], -1)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    normals = latitude.cos()[:, None, None] * ring + latitude.sin()[:, None, None] * up
    return _grid(shape.radius * normals, normals, wraps=(False, True))


def of_torus(shape: Torus, deviation: float) -> Triangles:
    """Return the surface of the whole ring `shape` around y; `deviation` as in `of_sphere`."""
    along = _angles(_divisions(shape.major + shape.minor, deviation / 2))
    around = _angles(_divisions(shape.minor, deviation / 2))
    out = torch.stack([along.cos(), torch.zeros_like(along), along.sin()], -1)
    axis = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    normals = around.cos()[:, None] * out[:, None] + around.sin()[:, None] * axis
    return _grid(shape.major * out[:, None] + shape.minor * normals, normals, wraps=(True, True))


def of_box(shape: Box) -> Triangles:
    """Return the surface of the cuboid `shape`, which is exact."""
    return joined([_rectangle(shape.half, axis, sign) for axis in range(3) for sign in (-1, 1)])


def of_bored_box(shape: BoredBox, deviation: float) -> Triangles:
    """Return the surface of the cuboid `shape` with a round hole along z; `deviation` as in `of_sphere`."""
    x, y, z = shape.half
    corner = math.atan2(y, x)
    # The faces around the hole are divided at directions that include the four corners.
    ends = [-corner, corner, math.pi - corner, math.pi + corner]
    count = _divisions(shape.radius, deviation)
    angle = torch.cat([_between(a, b, count) for a, b in zip(ends, [*ends[1:], ends[0] + 2 * math.pi], strict=True)])
    ring = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], -1)
    edge = ring / torch.maximum(angle.cos().abs() / x, angle.sin().abs() / y)[:, None]
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    around = torch.stack([edge, shape.radius * ring])
    caps = [_grid(around + h * up, (h / z * up).expand_as(around), wraps=(False, True)) for h in (-z, z)]
    wall = torch.stack([shape.radius * ring + z * up, shape.radius * ring - z * up])
    sides = [_rectangle(shape.half, axis, sign) for axis in (0, 1) for sign in (-1, 1)]
    return joined([*sides, *caps, _grid(wall, -ring.expand_as(wall), wraps=(False, True))])


def _divisions(radius: float, deviation: float) -> int:
    """Return the number of chords around a circle that are nowhere farther from it than `deviation`."""
    return max(math.ceil(math.pi / math.acos(max(1 - deviation / radius, 0.0))), 8)


def _angles(count: int) -> Tensor:
    """Return `count` angles, evenly spaced over a circle."""
    return 2 * math.pi * torch.arange(count, dtype=torch.float64) / count


def _between(start: float, end: float, count: int) -> Tensor:
    """Return the angles from `start` to before `end`, with the spacing of `count` over a circle."""
    steps = math.ceil(count * (end - start) / (2 * math.pi))
    return start + (end - start) * torch.arange(steps, dtype=torch.float64) / steps


def _rectangle(half: tuple[float, float, float], axis: int, sign: int) -> Triangles:
    """Return the face of a cuboid across an axis, on its negative or positive side."""
    normal = torch.zeros(3, dtype=torch.float64)
    normal[axis] = sign
    u, v = (axis + 1) % 3, (axis + 2) % 3
    corners = torch.zeros(2, 2, 3, dtype=torch.float64)
    corners[..., axis] = sign * half[axis]
    corners[:, :, u] = torch.tensor([-half[u], half[u]], dtype=torch.float64)[:, None]
    corners[:, :, v] = torch.tensor([-half[v], half[v]], dtype=torch.float64)
    return _grid(corners, normal.expand_as(corners), wraps=(False, False))


def _grid(vertices: Tensor, normals: Tensor, wraps: tuple[bool, bool]) -> Triangles:
    """Return the triangles of a grid of vertices (M, N, 3); the last row or column may be followed by the first.

    They are counterclockwise seen from where the normals point. Those without area, as at the poles of a ball, are left
    out.
    """
    rows, columns = vertices.shape[:2]
    i, j = torch.meshgrid(torch.arange(rows - (not wraps[0])), torch.arange(columns - (not wraps[1])), indexing="ij")
    a, b = i * columns + j, (i + 1) % rows * columns + j
    c, d = (i + 1) % rows * columns + (j + 1) % columns, i * columns + (j + 1) % columns
    faces = torch.cat([torch.stack(three, -1).view(-1, 3) for three in ((a, b, c), (a, c, d))])
    flat, n = vertices.reshape(-1, 3), normals.reshape(-1, 3)
    areas = torch.linalg.cross(flat[faces[:, 1]] - flat[faces[:, 0]], flat[faces[:, 2]] - flat[faces[:, 0]])
    facing = (areas * n[faces].sum(1)).sum(-1)
    faces = torch.where(facing[:, None] < 0, faces.flip(-1), faces)
    return Triangles(flat, n, faces[areas.norm(dim=-1) > 1e-12 * flat.abs().max() ** 2])
