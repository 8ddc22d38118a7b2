"""Visibility of the points of a surface to cameras.

A camera sees a point that is inside its image, at a pixel that counts, and not hidden by the surface itself. Many
points of the surface are drawn into a depth buffer of each camera. Its cells are wide enough to hold several. A point
is hidden if it lies behind the nearest in its cell by more than the surface's slope there explains.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from nerfloom.base.console import track
from nerfloom.cameras.cameras import Cameras
from nerfloom.evaluation.surfaces import Samples
from nerfloom.geometry.lenses import project

APART = 2.0
"""Width of a depth buffer's cells, in distances between neighbouring points."""
MOST_CELLS = 4_000_000
"""Maximum number of cells of a depth buffer."""
NEAR = 0.1
"""Fraction of the points that are nearer than the distance used to choose the width of cells."""
STEEPEST = 4.0
"""Maximum change of depth across a ray: the tangent of the angle between ray and normal, here 76 degrees. Points that
cameras see only at larger angles may count as hidden. With a larger maximum, points behind thin walls would count as
seen."""
UNKNOWN_SLOPE = 2.0
"""The same tangent where the back of a surface is not known."""
ORIENTED = 0.9
"""If this fraction of the nearest points faces the cameras, points that face away are on the back of something."""
TRIED = 16
"""Number of cameras that decide which way normals point."""

Shown = Callable[[int], "Tensor | None"]
"""Function from a camera's index to the pixels (H, W) bool of its image that count; None for all."""


@dataclass(frozen=True)
class Sightings:
    """Numbers of cameras that see each of N points."""

    inside: Tensor
    """(N,) number of cameras with the point inside their image."""
    shown: Tensor
    """(N,) number of these that show the point at a pixel that counts."""
    seen: Tensor
    """(N,) number of these that see the point, not hidden."""


def count_sightings(points: Samples, occluders: Samples, cameras: Cameras, shown: Shown, title: str) -> Sightings:
    """Count the cameras that see points of a surface.

    If normals point outwards, or all of them inwards, points are not seen from behind. If they point to both sides, as
    on a mesh without a common order of its faces, depth alone decides.

    Args:
        points: N points of the surface, scene coordinates.
        occluders: many points of the same surface.
        cameras: the cameras, on the CPU.
        shown: the pixels of their images that count.
        title: text of the progress bar.
    """
    outward = _outward(occluders, cameras)
    counts = torch.zeros(3, len(points.positions), dtype=torch.int32)
    for index in track(range(len(cameras)), title, total=len(cameras)):
        camera = cameras[index : index + 1]
        buffer = _DepthBuffer.of(occluders, camera)
        at, counted = _project(points, camera), shown(index)
        kept = at.inside if counted is None else at.inside & counted.reshape(-1)[at.cell(1.0, camera)]
        visible = kept & (at.distance <= buffer.behind(at, STEEPEST if outward else UNKNOWN_SLOPE))
        if outward:
            visible &= outward * at.cosine < 0
        counts += torch.stack([at.inside, kept, visible])
    return Sightings(*counts)


@dataclass(frozen=True)
class _Projected:
    """N points as one camera sees them."""

    column: Tensor
    """(N,) pixels from the left edge of the image."""
    row: Tensor
    """(N,) pixels from the upper edge."""
    inside: Tensor
    """(N,) whether the image contains the point."""
    distance: Tensor
    """(N,) distance along the ray, scene units."""
    cosine: Tensor
    """(N,) cosine between ray and normal; NaN for points without normals."""

    def cell(self, width: float, camera: Cameras) -> Tensor:
        """Return the cell (N,) of `width` pixels that holds each point, counted row by row; 0 outside of the image."""
        columns = math.ceil(camera.sizes[0][1] / width)
        column, row = ((place / width).where(self.inside, 0).long() for place in (self.column, self.row))
        return row * columns + column.clamp(max=columns - 1)


def _project(points: Samples, camera: Cameras) -> _Projected:
    pose = camera.camera_to_worlds[0].to(points.positions)
    local = (points.positions - pose[:, 3]) @ pose[:, :3]
    x, y, visible = project(camera.model, local, camera.distortion)
    column, row = x * camera.fx + camera.cx, y * camera.fy + camera.cy
    height, width = camera.sizes[0]
    inside = visible & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    distance = local.norm(dim=-1)
    rays = (points.positions - pose[:, 3]) / distance[:, None]
    if camera.model == "orthographic":
        distance, rays = -local[:, 2], -pose[:, 2].expand_as(rays)
    cosine = torch.full_like(distance, torch.nan) if points.normals is None else (rays * points.normals).sum(-1)
    return _Projected(column, row, inside, distance, cosine)


@dataclass(frozen=True)
class _DepthBuffer:
    """The distance to the nearest of many points in each cell of an image."""

    camera: Cameras
    width: float
    """Width of a cell, pixels."""
    nearest: Tensor
    """(C,) distance, scene units; inf where there is no point."""
    first: Tensor
    """(K,) cosine between ray and normal of the nearest point in each of the K cells that have one."""

    @classmethod
    def of(cls, occluders: Samples, camera: Cameras) -> _DepthBuffer:
        at = _project(occluders, camera)
        distance, (height, wide) = at.distance[at.inside], camera.sizes[0]
        width = (height * wide / MOST_CELLS) ** 0.5
        if len(distance):
            apart = occluders.spacing * float(camera.fx)  # pixels, at a distance of 1
            nearer = float(distance.kthvalue(1 + int(NEAR * (len(distance) - 1))).values)
            width = max(APART * apart / (1.0 if camera.model == "orthographic" else nearer), width)
        width = min(width, float(min(height, wide)))
        rows, columns = (math.ceil(side / width) for side in (height, wide))
        cells = at.cell(width, camera)[at.inside]
        nearest = distance.new_full((rows * columns,), torch.inf)
        nearest.scatter_reduce_(0, cells, distance, "amin")
        first = at.cosine[at.inside][distance == nearest[cells]]
        # Closed, so that a cell without points is not a hole if its neighbours have some.
        near = max_pool2d(-nearest.view(1, 1, rows, columns), 3, 1, 1)
        return cls(camera, width, max_pool2d(-near, 3, 1, 1).reshape(-1), first)

    def behind(self, at: _Projected, steepest: float) -> Tensor:
        """Return the maximum distance (N,) of a visible point towards each of several points, scene units.

        Args:
            at: the points.
            steepest: maximum change of depth across a ray.
        """
        away = torch.ones_like(at.distance) if self.camera.model == "orthographic" else at.distance
        across = self.width / float(self.camera.fx) * away
        slope = (1 - at.cosine.square()).clamp(min=0).sqrt() / at.cosine.abs()
        slope = slope.nan_to_num(nan=steepest).clamp(max=steepest)
        return self.nearest[at.cell(self.width, self.camera)] + across * (1 + 2 * slope)


def _outward(occluders: Samples, cameras: Cameras) -> int:
    """Return 1 if normals point to where cameras are, -1 if they point away from there, and 0 if neither is so."""
    if occluders.normals is None:
        return 0
    chosen = range(0, len(cameras), -(-len(cameras) // TRIED))
    first = torch.cat([_DepthBuffer.of(occluders, cameras[index : index + 1]).first for index in chosen])
    facing = float((first < 0).double().mean()) if len(first) else 0.5
    return 1 if facing > ORIENTED else -1 if facing < 1 - ORIENTED else 0
