"""Surfaces to compare: triangle meshes or points on a surface, and samples of them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from nerfloom.base.console import track
from nerfloom.base.counts import counted
from nerfloom.base.errors import DataError
from nerfloom.cameras.poses import Placement
from nerfloom.geometry.records import TensorRows
from nerfloom.geometry.triangles import area_vectors, draw_on_triangles, nearest_on_triangles

DENSE = 800_000
"""Default number of points on a mesh where nearest faces are looked for."""
CANDIDATES = 8
"""Number of nearest points on a mesh; their faces are compared exactly."""
UNIT = 1e-6
"""Maximum deviation of a normal's length from 1."""
AT_ONCE = 2**14
"""Number of positions in one search for nearest points."""


@dataclass(frozen=True)
class Surface:
    """A triangle mesh, or points on a surface. All coordinates are finite, and every face has an area."""

    points: Tensor
    """(V, 3) float64 vertices of the mesh, or points on the surface."""
    faces: Tensor | None = None
    """(F, 3) int64 vertices of the triangles; None for points."""
    normals: Tensor | None = None
    """(V, 3) float64 unit normals at the points; None if only faces have normals, or nothing."""

    @property
    def corners(self) -> Tensor:
        """(F, 3, 3) corners of the triangles of a mesh."""
        return self.points[self.faces]

    @property
    def side(self) -> float:
        """Longest side of the bounding box parallel to the axes."""
        used = self.points if self.faces is None else self.points[self.faces.reshape(-1)]
        return float((used.amax(0) - used.amin(0)).max())

    def describe(self) -> str:
        """Return a description of its size, as text."""
        if self.faces is None:
            return counted(len(self.points), "points") + ("" if self.normals is None else " with normals")
        return f"{len(self.faces):,} faces, {len(self.points):,} vertices"

    def at(self, faces: Tensor, weights: Tensor) -> Samples:
        """Return points of a mesh, with normals, on `faces` (N,) at barycentric `weights` (N, 3).

        The normals are interpolated from the vertices, where there are any; otherwise they belong to the faces.
        """
        assert self.faces is not None
        members = self.faces[faces]
        positions = (weights[:, None] @ self.points[members])[:, 0]
        if self.normals is None:
            return Samples(positions, normalize(area_vectors(self.points[members]), dim=-1, eps=0))
        return Samples(positions, normalize((weights[:, None] @ self.normals[members])[:, 0], dim=-1))


@dataclass(frozen=True)
class Samples(TensorRows):
    """N points of a surface."""

    positions: Tensor
    """(N, 3) positions."""
    normals: Tensor | None
    """(N, 3) unit normals; None if unknown."""
    spacing: float = 0.0
    """Distance between neighbours: the square root of the area for each point, on average."""

    def placed(self, placement: Placement) -> Samples:
        """Return points of the input's frame in the scene's frame, float32."""
        normals = None if self.normals is None else (self.normals @ placement.transform[:, :3].T).float()
        return Samples(placement.points(self.positions).float(), normals, self.spacing * placement.scale)


def usable(surface: Surface, name: str) -> tuple[Surface, list[str]]:
    """Return `surface`, `name` in messages, without infinite coordinates and faces without area, and notes on them.

    Raises:
        DataError: if nothing is left.
    """
    finite = surface.points.isfinite().all(-1)
    notes = [] if finite.all() else [f"{int((~finite).sum()):,} points with coordinates that are not finite"]
    if surface.faces is None:
        kept, normals = Surface(surface.points[finite]), surface.normals
        members = finite
    else:
        held = finite[surface.faces].all(-1)
        areas = area_vectors(surface.points[surface.faces]).norm(dim=-1)
        real = (areas > 0) & areas.isfinite()
        if (flat := int((held & ~real).sum())) > 0:
            notes.append(f"{flat:,} faces without a finite area")
        kept, normals = Surface(surface.points, surface.faces[held & real]), surface.normals
        members = torch.zeros_like(finite).index_fill_(0, surface.faces[held & real].reshape(-1), True)
        if not bool(members.any()):
            raise DataError(f"{name} has no face with an area")
    if not bool(members.any()) or not 0 < kept.side < math.inf:
        raise DataError(f"{name} has no two points at a finite distance")
    if normals is None:
        return kept, notes
    normals = normalize(normals, dim=-1)
    if not bool(((normals[members].norm(dim=-1) - 1).abs() < UNIT).all()):
        return kept, [*notes, "all normals, as some are zero or not finite"]
    return replace(kept, normals=normals[finite] if kept.faces is None else normals), notes


def drawn(surface: Surface, count: int, seed: int = 0) -> Samples:
    """Return `count` points of `surface`: by area on a mesh, by `seed`; all or some of given points."""
    if surface.faces is None:
        chosen = torch.arange(len(surface.points))
        if len(chosen) > count:
            chosen = torch.randperm(len(chosen), generator=torch.Generator().manual_seed(seed))[:count].sort().values
        spread = point_spacing(surface.points) * (len(surface.points) / len(chosen)) ** 0.5
        return Samples(surface.points, surface.normals, spread)[chosen]
    area = float(area_vectors(surface.corners).norm(dim=-1).sum()) / 2
    samples = surface.at(*draw_on_triangles(surface.corners, count, seed))
    return replace(samples, spacing=(area / count) ** 0.5)


def point_spacing(points: Tensor) -> float:
    """Return the distance between neighbours among `points` (N, 3) on a surface: twice the median to the nearest.

    For N points at random positions in an area, the mean distance to the nearest is half of sqrt(area / N).
    """
    if len(points) < 2:
        return 0.0
    distances, _ = _tree(points).query(_some(points).numpy(), k=2, workers=-1)
    return 2 * float(np.median(distances[:, 1]))


def _some(points: Tensor) -> Tensor:
    """Return at most `AT_ONCE` of the points, evenly spaced in their order."""
    return points[:: -(-len(points) // AT_ONCE)]


def nearest(positions: Tensor, surface: Surface, dense: int = DENSE) -> tuple[Tensor, Tensor | None]:
    """Return the distances (N,) of positions to a surface, and its normals (N, 3) at the nearest points.

    For a mesh, many points are drawn on it, at least one on each face. The faces of the `CANDIDATES` nearest points are
    compared, and the distance to the nearest of them is exact. Another face of the mesh may be nearer, but by less than
    the spacing of the points. So the distance of a mesh to itself is small, but not exactly 0.

    Args:
        positions: (N, 3) float64.
        surface: the surface.
        dense: number of points drawn on a mesh.

    Returns:
        Normals are None for points without normals.
    """
    if surface.faces is None:
        distances, indices = _tree(surface.points).query(positions.numpy(), workers=-1)
        normals = None if surface.normals is None else surface.normals[torch.from_numpy(indices)]
        return torch.from_numpy(distances), normals
    corners = surface.corners
    owners, weights = draw_on_triangles(corners, dense)
    bare = torch.ones(len(corners), dtype=torch.bool)
    bare[owners] = False
    # A small face without a point gets its centre.
    places = torch.cat([(weights[:, None] @ corners[owners])[:, 0], corners[bare].mean(1)])
    owners = torch.cat([owners, bare.nonzero()[:, 0]])
    tree = _tree(places)
    shortest_of, normals_of = list[Tensor](), list[Tensor]()
    parts = positions.split(AT_ONCE)
    for part in track(parts, "Measuring distances", total=len(parts)):
        found = torch.from_numpy(tree.query(part.numpy(), k=CANDIDATES, workers=-1)[1]).reshape(-1)
        repeated = part.repeat_interleave(CANDIDATES, dim=0)
        of_faces, away = nearest_on_triangles(repeated, corners[owners[found]])
        shortest, chosen = away.view(-1, CANDIDATES).min(-1)
        chosen += torch.arange(len(part)) * CANDIDATES
        shortest_of.append(shortest)
        there = surface.at(owners[found][chosen], of_faces[chosen]).normals
        assert there is not None
        normals_of.append(there)
    return torch.cat(shortest_of), torch.cat(normals_of)


def _tree(points: Tensor) -> Any:
    from scipy.spatial import cKDTree

    return cKDTree(points.numpy())
