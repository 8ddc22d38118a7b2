"""Distances between a mesh and an exact surface, given by its signed distance."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from nerfloom.export.mesh import Mesh

SignedDistance = Callable[[Tensor], Tensor]
"""Function from positions (N, 3) to signed distances (N,), negative inside a solid."""
SHELL = 0.01
"""Half the thickness of the shell where points are drawn, before they are moved to the surface."""
CHUNK = 2**17
"""Number of positions evaluated at once."""
MESH_SAMPLES = 1_000_000
"""Number of points on a mesh used to find the nearest faces."""
CANDIDATES = 8
"""Number of nearest points whose faces are compared exactly."""


def surface_sample(distance: SignedDistance, box: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return points (count, 3) float64 evenly distributed on a surface, and its outward normals.

    Points are drawn in a thin shell around the surface, and moved along the gradient of the distance. The distribution
    is even up to terms of the shell's thickness times the curvature.

    Args:
        distance: the surface.
        box: (2, 3) a box that holds it.
        count: number of points.
    """
    box, points, normals, found = box.double(), [], [], 0
    while found < count:
        drawn = box[0] + torch.rand(CHUNK, 3, dtype=torch.float64) * (box[1] - box[0])
        near = drawn[distance(drawn).abs() < SHELL]
        for _ in range(3):
            near = near - distance(near)[:, None] * _gradient(distance, near)
        points.append(near)
        normals.append(_gradient(distance, near))
        found += len(near)
    return torch.cat(points)[:count], torch.cat(normals)[:count]


def _gradient(distance: SignedDistance, points: Tensor) -> Tensor:
    """Return the unit gradient (N, 3) of a distance by central differences."""
    step = 1e-5
    offsets = step * torch.eye(3, dtype=points.dtype)
    columns = [distance(points + offset) - distance(points - offset) for offset in offsets]
    return torch.nn.functional.normalize(torch.stack(columns, -1), dim=-1)


def visible_from(distance: SignedDistance, points: Tensor, normals: Tensor, cameras: Tensor) -> Tensor:
    """Return whether each point of a surface is visible from any of several positions, (N,) bool, by sphere tracing.

    Fields of view are ignored: each camera sees the whole scene.

    Args:
        distance: the surface.
        points: (N, 3) points on it.
        normals: (N, 3) their outward normals.
        cameras: (M, 3) positions outside the solids.
    """
    seen = torch.zeros(len(points), dtype=torch.bool)
    starts = points + 1e-3 * normals
    for camera in cameras.double():
        left = (~seen).nonzero()[:, 0]
        towards = camera - starts[left]
        left = left[(towards * normals[left]).sum(-1) > 0]
        towards = camera - starts[left]
        length = towards.norm(dim=-1)
        directions = towards / length[:, None]
        t, free = torch.zeros(len(left), dtype=torch.float64), torch.ones(len(left), dtype=torch.bool)
        active = torch.arange(len(left))
        for _ in range(80):
            step = distance(starts[left[active]] + t[active, None] * directions[active])
            free[active[step < 1e-4]] = False
            t[active] += step.clamp(min=1e-4)
            active = active[(step >= 1e-4) & (t[active] < length[active])]
            if not len(active):
                break
        seen[left[free]] = True
    return seen


def mesh_sample(mesh: Mesh, count: int) -> tuple[Tensor, Tensor]:
    """Return points (count, 3) float64 evenly on a mesh, the same in every run, and the face (count,) of each.

    Args:
        count: number of points.
    """
    import trimesh

    made = trimesh.Trimesh(mesh.vertices.numpy(), mesh.faces.numpy(), process=False)
    points, faces = trimesh.sample.sample_surface(made, count, seed=0)[:2]
    return torch.from_numpy(np.array(points)), torch.from_numpy(np.array(faces))


def distances_to_mesh(points: Tensor, mesh: Mesh) -> Tensor:
    """Return the distance (N,) from points (N, 3) to a mesh, approximately: to the nearest of a few likely faces.

    `trimesh.proximity` compares all faces that may be the nearest, which takes minutes for a million of them.

    Args:
        points: (N, 3) positions.
    """
    import trimesh
    from scipy.spatial import cKDTree

    samples, faces = mesh_sample(mesh, MESH_SAMPLES)
    positions = points.double().numpy()
    nearest = cKDTree(samples.numpy()).query(positions, k=CANDIDATES, workers=-1)[1]
    corners = mesh.vertices.numpy()[mesh.faces.numpy()[faces.numpy()[nearest].reshape(-1)]]
    repeated = positions.repeat(CANDIDATES, axis=0)
    distances = np.linalg.norm(repeated - trimesh.triangles.closest_point(corners, repeated), axis=-1)
    return torch.from_numpy(distances.reshape(-1, CANDIDATES).min(-1))


def seen_samples(points: Tensor, normals: Tensor, cameras: Tensor, pixels: int = 128) -> Tensor:
    """Return whether each of many points on a mesh is visible from any of several positions, (N,) bool.

    Points are drawn into an image of all directions with a depth buffer. Points at most 2 % behind the nearest in their
    pixel count as visible. So a point hidden by another part at less than that distance also counts.

    Args:
        points: (N, 3) points, dense enough to leave no holes in an image.
        normals: (N, 3) normals of their faces.
        cameras: (M, 3) positions.
        pixels: height of the images; their width is twice that.
    """
    seen = torch.zeros(len(points), dtype=torch.bool)
    for camera in cameras.double():
        offset = points - camera
        distance = offset.norm(dim=-1)
        facing = (offset * normals).sum(-1) < 0
        # An equirectangular image of the part of the sphere where the points are.
        middle = torch.nn.functional.normalize(offset.mean(0), dim=0)
        aside = torch.linalg.cross(middle, torch.tensor([0.0, 0.0, 1.0], dtype=points.dtype) + 1e-6)
        aside = torch.nn.functional.normalize(aside, dim=0)
        frame = torch.stack([aside, torch.linalg.cross(middle, aside), middle])
        x, y, z = (offset / distance[:, None] @ frame.T).unbind(-1)
        longitude, latitude = torch.atan2(x, z), torch.asin(y.clamp(-1, 1))
        column = ((longitude - longitude.min()) / (longitude.max() - longitude.min()) * (2 * pixels - 1)).long()
        row = ((latitude - latitude.min()) / (latitude.max() - latitude.min()) * (pixels - 1)).long()
        pixel = row * 2 * pixels + column
        nearest = torch.full((2 * pixels * pixels,), torch.inf, dtype=points.dtype)
        nearest.scatter_reduce_(0, pixel, distance, "amin")
        seen |= facing & (distance <= 1.02 * nearest[pixel])
    return seen
