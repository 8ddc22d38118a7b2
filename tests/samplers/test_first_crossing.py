"""Sphere tracing of exact shapes against closed forms, and of a learnt ball against its volume."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from nerfloom.cameras.view import View
from nerfloom.evaluation.metrics import psnr
from nerfloom.geometry.points import Points
from nerfloom.geometry.rays import Rays
from nerfloom.kernels.surfaces.crossings import Pieces, crossings
from nerfloom.samplers.first_crossing import FirstCrossing
from nerfloom.testing.ball import RADIUS
from tests.test_surfaces import METHODS, trainer_of

SHORTEST = 1e-3


def random_rays(count: int = 400, spread: float = 0.7) -> Rays:
    """Rays from a sphere of radius 3 past the middle."""
    torch.manual_seed(0)
    origins = 3 * torch.nn.functional.normalize(torch.randn(count, 3, dtype=torch.float64), dim=-1)
    towards = spread * torch.randn(count, 3, dtype=torch.float64) - origins
    return Rays(origins, torch.nn.functional.normalize(towards, dim=-1))


def whole(rays: Rays, start: float = 0.0, end: float = 6.0) -> Pieces:
    """One piece a ray."""
    ones = torch.ones(len(rays), dtype=torch.float64)
    return Pieces(start * ones, end * ones, torch.arange(len(rays)), torch.arange(len(rays) + 1))


def traced(distance: Callable[[Tensor], Tensor], rays: Rays, pieces: Pieces | None = None) -> Tensor:
    """Distances (R,) along rays; infinite where they miss."""
    met = crossings(distance, rays, whole(rays) if pieces is None else pieces, SHORTEST)
    assert met.evaluations >= len(met.t)
    assert bool((met.owners.diff() > 0).all())
    assert bool((met.coverage == 1).all())
    at = torch.full((len(rays),), torch.inf, dtype=torch.float64)
    at[met.owners] = met.t
    return at


def ball(positions: Tensor) -> Tensor:
    return positions.norm(dim=-1) - 1


def ball_truth(rays: Rays) -> Tensor:
    middle = -(rays.origins * rays.directions).sum(-1)
    half = (1 - (rays.origins.square().sum(-1) - middle.square())).clamp(min=-1)
    return torch.where(half > 0, middle - half.clamp(min=0).sqrt(), torch.inf)


def chord(t: Tensor, other: Tensor) -> float:
    """Largest difference where both meet a surface; rays that only one meets are few and graze it."""
    both = t.isfinite() & other.isfinite()
    assert (t.isfinite() != other.isfinite()).float().mean() < 0.01
    return (t - other)[both].abs().max().item()


def test_a_ball_is_met_where_its_equation_says() -> None:
    rays = random_rays()
    truth = ball_truth(rays)
    assert 0.2 < truth.isfinite().double().mean() < 0.9
    error = chord(traced(ball, rays), truth)
    print(f"ball: {error:.1e}")
    assert error < 1e-4


@pytest.mark.parametrize(("offset", "meets"), [(1 - 1e-6, True), (1 + 1e-9, False), (1.2, False), (0.0, True)])
def test_rays_that_graze_or_miss(offset: float, meets: bool) -> None:
    """A ray that dives less than the shortest advance allows for is met or passed; beside the ball, none is met."""
    rays = Rays(torch.tensor([[offset, 0.0, -3]]).double(), torch.tensor([[0.0, 0, 1]]).double())
    t = traced(ball, rays)
    assert bool(t.isfinite()) == meets
    if meets:
        assert t.item() == pytest.approx(ball_truth(rays).item(), abs=1e-3)


def test_a_torus_is_met_at_the_first_root_of_its_quartic() -> None:
    large, small = 0.7, 0.25

    def torus(positions: Tensor) -> Tensor:
        across = positions[:, :2].norm(dim=-1) - large
        return (across.square() + positions[:, 2].square()).sqrt() - small

    rays = random_rays(300, 0.4)
    expected = []
    for o, d in zip(rays.origins.numpy(), rays.directions.numpy(), strict=True):
        # (|p|^2 + R^2 - r^2)^2 = 4 R^2 (x^2 + y^2) along the ray
        square = np.poly1d([1, 2 * o @ d, o @ o + large**2 - small**2])
        flat = np.poly1d([d[:2] @ d[:2], 2 * o[:2] @ d[:2], o[:2] @ o[:2]])
        roots = (square * square - 4 * large**2 * flat).roots
        real = roots[np.abs(roots.imag) < 1e-7].real
        expected.append(min(real[real > 0], default=np.inf))
    error = chord(traced(torus, rays), torch.tensor(expected))
    print(f"torus: {error:.1e}")
    assert error < 1e-4


def test_the_first_of_two_thin_sheets_is_met() -> None:
    """Sheets 0.004 apart and 0.002 thick, met at any angle, by advances that could pass both in empty space."""

    def sheets(positions: Tensor) -> Tensor:
        z = positions[:, 2]
        return torch.minimum(z.abs(), (z - 0.004).abs()) - 0.001

    rays = random_rays(500)
    rays = rays[rays.origins[:, 2].abs() > 0.01]
    below, rise = rays.origins[:, 2] < 0, rays.directions[:, 2]
    near = torch.where(below, -0.001, 0.005)
    truth = (near - rays.origins[:, 2]) / rise
    truth = torch.where((truth > 0) & (truth < 5.9), truth, torch.inf)
    t = traced(sheets, rays, whole(rays, end=5.9))
    inner = ~((truth - 5.9).abs() < 2 * SHORTEST)  # matter that begins there may be thinner than the shortest advance
    assert torch.equal(t.isfinite()[inner], truth.isfinite()[inner])
    assert (t - truth)[t.isfinite() & truth.isfinite()].abs().max() < 1e-6


def test_a_ray_that_starts_inside_has_to_leave_first() -> None:
    """It leaves one ball and meets another; with no other it meets nothing."""

    def two(positions: Tensor) -> Tensor:
        return torch.minimum(ball(positions), ball(positions - torch.tensor([0.0, 0, 4])))

    rays = Rays(torch.tensor([[0.1, 0, 0.2]]).double(), torch.tensor([[0.0, 0, 1]]).double())
    assert traced(two, rays).item() == pytest.approx(4 - 0.2 - (1 - 0.01) ** 0.5, abs=1e-6)
    assert traced(ball, rays).item() == torch.inf
    cut = whole(rays, 0.5, 6.0)  # a face of the box cuts through the ball: space before it is outside
    assert traced(ball, rays, cut).item() == 0.5


def test_only_the_pieces_are_searched() -> None:
    """Space between them is outside, so a surface in a gap is passed and the next piece's is met."""
    rays = random_rays(50, 0.3)
    count = len(rays)
    truth = ball_truth(rays)
    starts = torch.stack([torch.zeros(count).double(), truth + 0.1], -1).reshape(-1)
    ends = torch.stack([truth - 0.1, truth + 0.2], -1).reshape(-1)
    pieces = Pieces(starts, ends, torch.arange(count).repeat_interleave(2), 2 * torch.arange(count + 1))
    deep = ball(rays.points(torch.arange(count), truth + 0.1)) < 0
    assert deep.sum() > 40
    torch.testing.assert_close(traced(ball, rays, pieces)[deep], (truth + 0.1)[deep])
    nothing = Pieces(starts[:0], ends[:0], pieces.owners[:0], torch.zeros(count + 1, dtype=torch.int64))
    assert not traced(ball, rays, nothing).isfinite().any()


def test_a_distance_that_is_too_long_is_led_back() -> None:
    """The distance is 15 % too long: rays pass the surface and are inside."""
    rays = random_rays()
    truth = ball_truth(rays)
    deep = truth.isfinite() & (ball(rays.points(torch.arange(len(rays)), truth + 0.3)) < -0.1)
    error = (traced(lambda positions: 1.15 * ball(positions), rays) - truth)[deep].abs().max().item()
    print(f"led back: {error:.1e}")
    assert error < 1e-4


def test_a_broken_distance_shows() -> None:
    rays = random_rays(5)
    assert traced(lambda positions: torch.full_like(positions[:, 0], torch.nan), rays).isfinite().all()


def test_edges_cover_the_share_of_a_pixel_that_they_hide() -> None:
    """Edges of a ball are compared with rays at random places in square pixels; the cone has the pixel's variance."""
    torch.manual_seed(0)
    width, offsets = 0.02, torch.linspace(0.97, 1.03, 31, dtype=torch.float64)
    turn = torch.rand(31, dtype=torch.float64) * 2 * torch.pi
    places = offsets[:, None] * torch.stack([turn.cos(), turn.sin()], -1)
    inside = (places[:, None] + width * (torch.rand(31, 4000, 2, dtype=torch.float64) - 0.5)).norm(dim=-1) < 1
    origins = torch.cat([places, torch.full((31, 1), -3.0, dtype=torch.float64)], -1)
    ahead = torch.tensor([0.0, 0, 1]).double().expand(31, 3)
    radii = torch.full((31,), width / 12**0.5 / 3).double()  # at distance 3; the ball's edge is there
    met = crossings(ball, Rays(origins, ahead, pixel_radii=2 * radii), whole(Rays(origins, ahead)), SHORTEST)
    found = torch.zeros(31, dtype=torch.float64)
    found[met.owners] = met.coverage
    error = (found - inside.double().mean(-1)).abs()
    print(f"coverage off by {error.mean():.3f}, at most {error.max():.3f}")
    assert error.max() < 0.12
    assert error.mean() < 0.03
    assert ((found > 0.05) & (found < 0.95)).sum() > 5


def test_what_an_edge_leaves_free_meets_the_surface_behind() -> None:
    """A ray that grazes a ball before a wall: part of the ball, then all of the wall."""

    def with_wall(positions: Tensor) -> Tensor:
        return torch.minimum(ball(positions), 2 - positions[:, 2])

    for offset, share in ((0.995, 0.75), (1.005, 0.25), (1.02, 0.0), (0.9, 1.0)):
        origins = torch.tensor([[offset, 0.0, -3]]).double()
        ahead, radius = torch.tensor([[0.0, 0, 1]]).double(), torch.tensor([0.01 / 3]).double()
        met = crossings(with_wall, Rays(origins, ahead, pixel_radii=radius), whole(Rays(origins, ahead)), SHORTEST)
        expected = [share] * (share > 0) + [1.0] * (share < 1)
        assert met.coverage.tolist() == pytest.approx(expected, abs=0.05)
        assert met.owners.tolist() == [0] * len(expected)
        if share < 1:
            assert met.t[-1].item() == pytest.approx(5.0, abs=1e-6)


@pytest.mark.parametrize("distance", [3.0, 30.0])
def test_edges_of_parallel_rays_cover_as_much_far_as_near(distance: float) -> None:
    ahead, radius = torch.tensor([[0.0, 0, 1]]).double(), torch.tensor([0.01]).double()
    rays = Rays(torch.tensor([[1.005, 0.0, -distance]]).double(), ahead, pixel_radii=radius, parallel=True)
    met = crossings(ball, rays, whole(rays, end=2 * distance), SHORTEST)
    assert met.coverage.tolist() == pytest.approx([0.25], abs=0.05)


@pytest.mark.medium
@pytest.mark.parametrize("name", METHODS)
def test_a_learnt_ball_is_drawn_as_its_volume(name: str) -> None:
    """Colours, depth, opacity and normals; by fewer evaluations of colour."""
    torch.manual_seed(0)
    trainer = trainer_of(name, 48, max_num_iterations=250, num_rays_per_batch=512, start_radius=0.8)
    for _ in trainer.steps():
        pass
    model = trainer.model.eval()
    view, background = View.of(trainer.train_set.cameras, 3, None), torch.ones(3)
    volume = model.render_view(view, background)
    sampler = next(part for part in model.modules() if isinstance(part, FirstCrossing))
    sampler.traces = True
    surface = model.render_view(view, background)
    assert psnr(surface.rgb, volume.rgb) > 24
    solid = (volume.accumulation > 0.99) & (surface.accumulation > 0.999)
    assert solid.float().mean() > 0.1
    assert (surface.depth - volume.depth)[solid].abs().median() < 0.05 * RADIUS
    assert (surface.extras["normals"] * volume.extras["normals"]).sum(-1)[solid].median() > 0.98
    points = view.camera.pixel_rays(view.pixels().reshape(-1)[solid.reshape(-1)], 0.0, 10.0)
    where = points.origins + points.directions * surface.depth[solid][:, None]
    distances, _ = model.signed_distance(Points(where))
    assert distances.abs().quantile(0.95) < 1e-3 * RADIUS
