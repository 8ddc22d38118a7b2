"""Distances between meshes and exact surfaces, against distances that are known."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from benchmarks.chamfer import (
    distances_to_mesh,
    mesh_sample,
    seen_samples,
    surface_sample,
    visible_from,
)
from nerfloom.dataparsers.procedural.scene import inside, signed_distance, trace
from nerfloom.export.mesh import Mesh

trimesh = pytest.importorskip("trimesh")
CUBE = torch.tensor([[-1.5, -1.5, -1.5], [1.5, 1.5, 1.5]])


def sphere(radius: float, level: int = 4) -> Mesh:
    made = trimesh.creation.icosphere(subdivisions=level, radius=radius)
    return Mesh(torch.from_numpy(np.array(made.vertices)), torch.from_numpy(np.array(made.faces)).long())


def ball(points: Tensor) -> Tensor:
    return points.norm(dim=-1) - 1


def test_points_are_even_on_the_surface_of_a_ball() -> None:
    torch.manual_seed(0)
    points, normals = surface_sample(ball, CUBE, 20_000)
    assert float(ball(points).abs().max()) < 1e-9
    torch.testing.assert_close(normals, points, atol=1e-4, rtol=0)
    # By Archimedes, heights are uniform; the shell is uneven by its thickness squared.
    assert float((points.sort(0).values - torch.linspace(-1, 1, 20_000)[:, None]).abs().max()) < 0.03


@pytest.mark.medium
def test_distances_of_concentric_balls() -> None:
    mesh = sphere(0.9)
    points, _ = surface_sample(ball, CUBE, 2000)
    torch.testing.assert_close(distances_to_mesh(points, mesh), torch.full((2000,), 0.1).double(), atol=2e-3, rtol=0)
    samples, faces = mesh_sample(mesh, 5000)
    torch.testing.assert_close(ball(samples).abs(), torch.full((5000,), 0.1).double(), atol=2e-3, rtol=0)
    assert float((samples - mesh.vertices[mesh.faces[faces]].mean(1)).norm(dim=-1).max()) < 0.1


@pytest.mark.medium
def test_distances_to_a_mesh_are_those_to_the_nearest_of_all_its_faces() -> None:
    torch.manual_seed(0)
    mesh, points = sphere(0.7, level=2), 2 * torch.rand(40, 3).double() - 1
    weights = torch.cartesian_prod(*[torch.linspace(0, 1, 30)] * 2).double()
    weights = weights[weights.sum(-1) <= 1 + 1e-9]
    weights = torch.cat([weights, 1 - weights.sum(-1, keepdim=True)], -1)
    brute = torch.cdist(points, (weights @ mesh.vertices[mesh.faces]).reshape(-1, 3)).amin(-1)
    found = distances_to_mesh(points, mesh)
    assert bool((found <= brute + 1e-9).all())
    assert float((brute - found).max()) < 0.005


def test_a_camera_sees_its_half_of_a_ball() -> None:
    torch.manual_seed(0)
    points, normals = surface_sample(ball, CUBE, 2000)
    camera = torch.tensor([[4.0, 0, 0]])
    expected = points[:, 0] > 0.25  # the horizon from a distance of 4
    clear = (points[:, 0] - 0.25).abs() > 0.02
    assert torch.equal(visible_from(ball, points, normals, camera)[clear], expected[clear])
    samples, _ = mesh_sample(sphere(1.0), 200_000)
    seen = seen_samples(samples, torch.nn.functional.normalize(samples, dim=-1), camera)
    clear = (samples[:, 0] - 0.25).abs() > 0.05
    assert float((seen == (samples[:, 0] > 0.25))[clear].float().mean()) > 0.99  # but for pixels at the horizon


def test_what_is_behind_is_not_seen() -> None:
    wall = torch.cat([torch.rand(300_000, 2) - 0.5, torch.zeros(300_000, 1)], -1).double()
    behind = 0.5 * wall[:50_000] - torch.tensor([0, 0, 1.0])
    up = torch.tensor([[0.0, 0, 1]]).double().expand(350_000, 3)
    seen = seen_samples(torch.cat([wall, behind]), up, torch.tensor([[0.1, 0.1, 3.0]]))
    assert float(seen[:300_000].float().mean()) > 0.99
    assert float(seen[300_000:].float().mean()) < 0.01


def test_the_embedded_scenes_distance_is_that_of_its_rays() -> None:
    """No ray hits before the distance says that it may, and where it hits the distance is 0."""
    torch.manual_seed(0)
    origins = 4 * torch.nn.functional.normalize(torch.randn(3000, 3).double(), dim=-1)
    directions = torch.nn.functional.normalize(0.8 * torch.randn(3000, 3).double() - origins, dim=-1)
    hit = trace(origins, directions)
    places = origins + hit.depth[:, None] * directions
    assert float(signed_distance(places[hit.hit]).abs().max()) < 1e-7
    assert bool((signed_distance(origins)[hit.hit] <= hit.depth[hit.hit] + 1e-9).all())
    points = 3 * torch.rand(3000, 3).double() - 1.5
    assert torch.equal(inside(points), signed_distance(points) < 0)
    assert math.isclose(float(hit.hit.float().mean()), 0.5, abs_tol=0.4)
