"""Spheres and the inverted sphere against closed forms, the paper's rotation, and differences; in float64."""

import math

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from nerfloom.geometry.rays import Rays
from nerfloom.geometry.spheres import InvertedRays, distances_behind, intersect_sphere, nearest_to_centre

UNIT = torch.tensor([0.0, 0.0, 0.0, 1.0]).double()
MOVED = torch.tensor([0.3, -1.0, 2.0, 2.5]).double()


def random_rays(sphere: Tensor, count: int = 200, most: float = 0.95, seed: int = 0) -> Rays:
    """Rays from random places within `most` radii of a sphere's centre."""
    generator = torch.Generator().manual_seed(seed)
    places = normalize(torch.randn(count, 3, generator=generator).double(), dim=-1)
    reach = most * torch.rand(count, 1, generator=generator).double()
    directions = normalize(torch.randn(count, 3, generator=generator).double(), dim=-1)
    return Rays(sphere[:3] + sphere[3] * reach * places, directions, fars=torch.full((count,), 1e9).double())


def one(origin: tuple[float, ...], direction: tuple[float, ...], **ends: float) -> Rays:
    given = {name: torch.tensor([value]).double() for name, value in ends.items()}
    return Rays(torch.tensor([origin]).double(), normalize(torch.tensor([direction]).double(), dim=-1), **given)


@pytest.mark.parametrize(
    ("origin", "direction", "expected"),
    [
        ((0, 0, 0), (0, 0, 1), (0, 1)),  # from the centre
        ((0, 0, -3), (0, 0, 1), (2, 4)),  # through the centre, from outside
        ((0, 0, 0.5), (0, 0, 1), (0, 0.5)),
        ((0, 0, 0.5), (0, 0, -1), (0, 1.5)),
        ((0.6, 0, -2), (0, 0, 1), (1.2, 2.8)),  # beside the centre: half a chord of 0.8
        ((0.6, 0, 0), (0, 0, 1), (0, 0.8)),
        ((1, 0, -2), (0, 0, 1), (0, 0)),  # touches
        ((2, 0, -2), (0, 0, 1), (0, 0)),  # misses
        ((0, 0, 3), (0, 0, 1), (0, 0)),  # behind
        ((0, 0, 1), (0, 0, 1), (0, 0)),  # on the sphere, leaving it
        ((0, 0, -1), (0, 0, 1), (0, 2)),  # on the sphere, entering it
    ],
)
def test_rays_meet_a_sphere_where_they_should(
    origin: tuple[float, ...], direction: tuple[float, ...], expected: tuple[float, float]
) -> None:
    for sphere in (UNIT, MOVED):
        rays, scale = one(origin, direction), float(sphere[3])
        enter, leave = intersect_sphere(sphere[:3] + scale * rays.origins, rays.directions, sphere)
        assert (enter.item(), leave.item()) == pytest.approx((scale * expected[0], scale * expected[1]), abs=1e-7)


def test_the_ends_of_chords_are_on_the_sphere() -> None:
    rays = random_rays(MOVED, most=3.0)
    enter, leave = intersect_sphere(rays.origins, rays.directions, MOVED)
    assert 30 < int((leave > 0).sum()) < 190
    for t in (enter[enter > 0], leave[leave > 0]):
        assert len(t) > 10
    for t in (enter, leave):
        ends = rays.origins + t[:, None] * rays.directions
        torch.testing.assert_close((ends - MOVED[:3]).norm(dim=-1)[t > 0], MOVED[3].expand(int((t > 0).sum())))


def test_chords_have_gradients_that_differences_find() -> None:
    rays = random_rays(MOVED, 20)
    origins, directions = rays.origins.clone().requires_grad_(), rays.directions.clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda o, d: intersect_sphere(o, d, MOVED)[1], (origins, directions))
    touching = one((1, 0, -2), (0, 0, 1)).origins.requires_grad_()
    intersect_sphere(touching, torch.tensor([[0.0, 0.0, 1.0]]).double(), UNIT)[1].sum().backward()
    assert bool(torch.isfinite(touching.grad).all())


# -- the inverted sphere ------------------------------------------------------------------------------------------


def inverted(positions: Tensor, sphere: Tensor) -> Tensor:
    """Points of the inverted sphere by their definition."""
    offsets = (positions - sphere[:3]) / sphere[3]
    return torch.cat([normalize(offsets, dim=-1), 1 / offsets.norm(dim=-1, keepdim=True)], dim=-1)


@pytest.mark.parametrize("sphere", [UNIT, MOVED])
@pytest.mark.parametrize("u", [0.0, 0.1, 0.5, 0.99, 1 - 1e-6])
def test_points_are_those_of_the_ray_at_their_distance(sphere: Tensor, u: float) -> None:
    rays = random_rays(sphere)
    places = torch.full((200,), u, dtype=torch.float64)
    behind = InvertedRays.of(rays, sphere)
    found = behind.points(torch.arange(200), places)
    t = distances_behind(places, rays, sphere)
    torch.testing.assert_close(found, inverted(rays.points(torch.arange(200), t), sphere), rtol=1e-7, atol=1e-7)
    assert float((found[:, :3].norm(dim=-1) - 1).abs().max()) < 1e-7
    torch.testing.assert_close(behind.nears, torch.zeros(200).double(), rtol=0, atol=1e-12)


@pytest.mark.parametrize("inverse", [0.9, 0.3, 1e-3])
def test_points_are_those_of_the_papers_rotation(inverse: float) -> None:
    """The exit from the sphere, turned in the plane of the ray and the centre by asin |b| - asin (|b| / r)."""
    rays = random_rays(UNIT)
    _, leave = intersect_sphere(rays.origins, rays.directions, UNIT)
    exits = rays.origins + leave[:, None] * rays.directions
    distance = torch.linalg.cross(rays.origins, rays.directions).norm(dim=-1)  # |b|, of the ray's line
    axes = normalize(torch.linalg.cross(exits, rays.directions), dim=-1)
    angle = (distance.asin() - (distance * inverse).asin())[:, None]
    turned = exits * angle.cos() + torch.linalg.cross(axes, exits) * angle.sin()  # Rodrigues; the axis is across
    found = InvertedRays.of(rays, UNIT).points(torch.arange(200), torch.full((200,), 1 - inverse, dtype=torch.float64))
    torch.testing.assert_close(found[:, :3], turned, rtol=1e-9, atol=1e-9)
    assert bool((found[:, 3] - inverse).abs().max() < 1e-12)


def test_at_infinity_a_ray_is_at_its_direction_and_through_the_centre_always() -> None:
    rays = random_rays(MOVED)
    far = InvertedRays.of(rays, MOVED).points(torch.arange(200), torch.ones(200).double())
    assert torch.equal(far[:, :3], rays.directions)
    assert not far[:, 3].any()
    central = InvertedRays.of(one((0, 0, 0), (1, 2, 3)), UNIT).points(torch.zeros(9).long(), torch.rand(9).double())
    torch.testing.assert_close(central[:, :3], normalize(torch.tensor([[1.0, 2, 3]]).double(), dim=-1).expand(9, 3))


@pytest.mark.parametrize(
    ("origin", "direction", "start"),
    [
        ((0, 0, -4), (0, 0, 1), 1.0),  # enters the sphere and leaves it: outside from there
        ((2, 0, -4), (0, 0, 1), 2.0),  # misses it: from where it is nearest
        ((2, 0, 3), (0, 0, 1), math.sqrt(13)),  # misses it, and has been nearest before it starts
        ((0, 0, 4), (0, 0, 1), 4.0),  # looks away from it
        ((1, 0, -4), (0, 0, 1), 1.0),  # touches it
        ((0.999999, 0, -4), (0, 0, 1), 1.0),  # grazes it
    ],
)
def test_cameras_outside_see_what_is_behind(
    origin: tuple[float, ...], direction: tuple[float, ...], start: float
) -> None:
    rays = one(origin, direction)
    rays.origins.requires_grad_()
    behind = InvertedRays.of(rays, UNIT)
    assert float(1 / (1 - behind.nears)) == pytest.approx(start, rel=1e-6)
    assert float(behind.fars) == 1
    u = torch.lerp(behind.nears, behind.fars, torch.linspace(0, 1, 50).double())
    points = behind.points(torch.zeros(50).long(), u)
    assert float((points[:, :3].norm(dim=-1) - 1).abs().max()) < 1e-6
    (gradient,) = torch.autograd.grad(points.sum(), rays.origins)
    assert bool(torch.isfinite(gradient).all())


def test_points_have_gradients_that_differences_find() -> None:
    rays, owners = random_rays(MOVED, 10), torch.arange(10).repeat(3)
    u = torch.rand(30, generator=torch.Generator().manual_seed(1)).double()

    def points(origins: Tensor, directions: Tensor) -> Tensor:
        return InvertedRays.of(Rays(origins, directions), MOVED).points(owners, u)

    inputs = rays.origins.clone().requires_grad_(), rays.directions.clone().requires_grad_()
    assert torch.autograd.gradcheck(points, inputs)


def test_what_ends_before_the_sphere_has_no_length_and_ends_are_kept() -> None:
    short = InvertedRays.of(one((0, 0, 0), (0, 0, 1), fars=0.7), UNIT)
    assert (short.nears.item(), short.fars.item()) == (0, 0)
    whole = InvertedRays.of(one((0, 0, 0), (0, 0, 1), nears=2.0, fars=8.0), UNIT)
    assert (whole.nears.item(), whole.fars.item()) == pytest.approx((0.5, 0.875))
    assert float(distances_behind(torch.tensor([1.0]).double(), one((0, 0, 0), (0, 0, 1), fars=8.0), UNIT)) == 8


def test_the_rest_of_a_ray_goes_along() -> None:
    rays = Rays(torch.zeros(3, 3), normalize(torch.ones(3, 3), dim=-1), camera_indices=torch.tensor([2, 0, 1]))
    behind = InvertedRays.of(rays, UNIT.float())[torch.tensor([True, False, True])]
    assert isinstance(behind, InvertedRays)
    assert len(behind) == 2
    assert behind.camera_indices.tolist() == [2, 1]
    assert InvertedRays.of(rays[:0], UNIT.float()).points(torch.zeros(0).long(), torch.zeros(0)).shape == (0, 4)


def test_float32_is_enough_far_out() -> None:
    rays = random_rays(MOVED)
    single = Rays(rays.origins.float(), rays.directions.float())
    u = 1 - torch.logspace(-7, 0, 200).double()
    truth = InvertedRays.of(rays, MOVED).points(torch.arange(200), u.float().double())
    found = InvertedRays.of(single, MOVED.float()).points(torch.arange(200), u.float())
    assert float((found - truth).abs().max()) < 1e-5
    middles, nearest = nearest_to_centre(rays.origins, rays.directions, MOVED)
    assert float((nearest * rays.directions).sum(-1).abs().max()) < 1e-12
    assert float(middles.abs().max()) < 0.95 * MOVED[3]
