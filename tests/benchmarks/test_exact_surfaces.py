"""Points on exact surfaces, and their visibility from cameras, against closed forms."""

import math

import torch
from torch import Tensor

from benchmarks.exact_surfaces import surface_sample, visible_from
from nerfloom.dataparsers.procedural.scene import inside, signed_distance, trace

CUBE = torch.tensor([[-1.5, -1.5, -1.5], [1.5, 1.5, 1.5]])


def ball(points: Tensor) -> Tensor:
    return points.norm(dim=-1) - 1


def test_points_are_even_on_the_surface_of_a_ball() -> None:
    torch.manual_seed(0)
    points, normals = surface_sample(ball, CUBE, 20_000)
    assert float(ball(points).abs().max()) < 1e-9
    torch.testing.assert_close(normals, points, atol=1e-4, rtol=0)
    # Heights are uniform (Archimedes); the shell is uneven by its thickness squared.
    assert float((points.sort(0).values - torch.linspace(-1, 1, 20_000)[:, None]).abs().max()) < 0.03


def test_a_camera_sees_its_half_of_a_ball() -> None:
    torch.manual_seed(0)
    points, normals = surface_sample(ball, CUBE, 2000)
    camera = torch.tensor([[4.0, 0, 0]])
    expected = points[:, 0] > 0.25  # the horizon from a distance of 4
    clear = (points[:, 0] - 0.25).abs() > 0.02
    assert torch.equal(visible_from(ball, points, normals, camera)[clear], expected[clear])


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
