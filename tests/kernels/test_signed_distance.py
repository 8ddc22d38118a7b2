"""A signed distance for compiled calls: values without a gradient, and rays that meet its zero level set."""

from functools import partial

import pytest
import torch
from torch import Tensor

from nerfloom.geometry.bounds import intersect_box
from nerfloom.geometry.rays import Rays
from nerfloom.kernels.dispatch import FEW_OPERATIONS
from nerfloom.kernels.grids.hash_grid_layout import HashGridLayout
from nerfloom.kernels.march.occupancy import Occupancy
from nerfloom.kernels.march.waves import march
from nerfloom.kernels.surfaces.crossings import Crossings, crossings, marched_crossings, pieces_of
from nerfloom.kernels.surfaces.samples import NO_FLOOR, FirstShape
from nerfloom.kernels.surfaces.signed_distance import (
    SIGNED_DISTANCES,
    SignedDistance,
    signed_distances,
    signed_distances_reference,
    stepped,
)
from tests.kernels.compiled import needs_kernels, relative_error

LAYOUT = HashGridLayout.build(4, 4, 40, 9)
BOX = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
RADIUS, FLOOR, CELLS, STEP, SHORTEST, SAFETY = 0.6, -0.3, 32, 0.02, 1e-3, 1.25


def ball(amplitude: float = 0.0, floor: bool = True) -> SignedDistance:
    """A ball at the origin, on a floor z = -0.3 or without, plus an amplitude times a random network."""
    torch.manual_seed(0)
    shape = FirstShape(
        torch.zeros(3),
        torch.full((3,), 0.5),
        1.0,
        RADIUS,
        1e-4,
        torch.tensor([0.0, 0.0, 1.0, FLOOR] if floor else NO_FLOOR),
    )
    weights = torch.randn(24, 8) / 8**0.5, torch.randn(5, 24) / 24**0.5
    table = amplitude * torch.randn(LAYOUT.num_entries, 2)
    return SignedDistance(torch.full((3,), 0.5), table, LAYOUT, *weights, shape)


def double(known: SignedDistance) -> SignedDistance:
    shape = known.shape
    shape = shape._replace(centre=shape.centre.double(), scale=shape.scale.double(), floor=shape.floor.double())
    tensors = {name: getattr(known, name).double() for name in ("shift", "table", "first", "second")}
    return known._replace(**tensors, shape=shape)


def places(count: int = 2_000) -> Tensor:
    """Positions in the box and around it."""
    torch.manual_seed(1)
    return 2.4 * torch.rand(count, 3) - 1.2


def rays_of(count: int = 1_500, radii: bool = False) -> Rays:
    """Rays from a sphere of radius 3 past the middle."""
    torch.manual_seed(2)
    origins = 3 * torch.nn.functional.normalize(torch.randn(count, 3), dim=-1)
    towards = 0.5 * torch.randn(count, 3) - origins
    directions = torch.nn.functional.normalize(towards, dim=-1)
    return Rays(origins, directions, pixel_radii=torch.full((count,), 0.004) if radii else None)


def met(rays: Rays, known: SignedDistance, occupied: Tensor | None = None) -> Crossings:
    """Crossings by the operation that suits the rays' type and device."""
    cells = torch.ones(CELLS**3, dtype=torch.bool) if occupied is None else occupied
    marched = march(rays, Occupancy(cells, BOX.to(rays.origins), CELLS), STEP, 0.0, None, 0.0)
    return marched_crossings(marched, known, SHORTEST, SAFETY)


def first_of(found: Crossings, count: int) -> Tensor:
    """The distance (R,) of each ray's first crossing; infinite without one."""
    t = torch.full((count,), torch.inf, dtype=torch.float64)
    return t.scatter_reduce(0, found.owners, found.t.double(), "amin")


def in_double(rays: Rays) -> Rays:
    return Rays(*(None if x is None else x.double() for x in (
        rays.origins, rays.directions, rays.nears, rays.fars, rays.pixel_radii
    )))  # fmt: skip  # type: ignore[arg-type]


@needs_kernels
@pytest.mark.parametrize("floor", [True, False])
def test_values_equal_the_reference_and_those_with_gradients(floor: bool) -> None:
    known = ball(0.3, floor)
    truth = signed_distances_reference(places().double(), double(known))
    with torch.no_grad():
        found = signed_distances(places(), known)
        both, _ = known.with_gradients(places())
    assert SIGNED_DISTANCES.choose((places(), known.table), places(), known).backend.name == "c++"
    assert relative_error(found, truth) < 1e-5
    assert relative_error(both, truth) < 1e-5
    few = next(each.run for each in SIGNED_DISTANCES.implementations if each.backend is FEW_OPERATIONS)
    torch.testing.assert_close(few(places().double(), double(known)), truth)


@needs_kernels
def test_a_broken_table_shows_in_values() -> None:
    known = ball(0.3)
    known.table[3] = torch.nan
    with torch.no_grad():
        found, truth = (run(places(), known) for run in (signed_distances, signed_distances_reference))
        assert signed_distances(places()[:0], known).shape == (0,)
    assert torch.equal(found.isnan(), truth.isnan())
    assert 0 < int(found.isnan().sum()) < len(found)


def test_a_step_of_a_distance_with_bounded_slope_passes_no_surface() -> None:
    """A distance that is `stretch` times too long, so that the safety is exactly enough, on rays of any angle."""
    torch.manual_seed(0)
    stretch = SAFETY
    origins = 2 * torch.nn.functional.normalize(torch.randn(500, 3, dtype=torch.float64), dim=-1)
    directions = torch.nn.functional.normalize(torch.randn(500, 3, dtype=torch.float64), dim=-1)
    too_long = stretch * (origins.norm(dim=-1) - 1)
    for slope in (0.5, 1.0):  # a gradient shorter than 1 counts as 1
        steps = stepped(too_long, slope * torch.nn.functional.normalize(origins, dim=-1), SAFETY)
        assert bool(((origins + steps[:, None] * directions).norm(dim=-1) >= 1 - 1e-12).all())
    half = stepped(too_long, 2 * torch.nn.functional.normalize(origins, dim=-1), SAFETY)
    torch.testing.assert_close(half, too_long / (2 * SAFETY))


@needs_kernels
def test_a_ball_on_a_floor_is_met_where_its_equations_say() -> None:
    """Where a ray enters the box inside the floor, it meets the face of the box."""
    rays = rays_of()
    truth_rays = in_double(rays)
    o, d = truth_rays.origins, truth_rays.directions
    enter, leave = intersect_box(o, d, BOX.double())
    middle = -(o * d).sum(-1)
    nearest = (o + middle[:, None] * d).norm(dim=-1)
    half = (RADIUS**2 - nearest.square()).clamp(min=0).sqrt()
    at_ball = torch.where(nearest < RADIUS, middle - half, torch.inf)
    below = o[:, 2] + enter * d[:, 2] < FLOOR
    at_floor = torch.where(below, enter, torch.where(d[:, 2] < 0, (FLOOR - o[:, 2]) / d[:, 2], torch.inf))
    truth = torch.minimum(at_ball, at_floor)
    truth = torch.where((truth < leave) & (leave > enter), truth, torch.inf)
    # Rays that graze the ball, or meet something within the last steps, may be decided either way.
    clear = (
        ((nearest - RADIUS).abs() > 1e-3) & ((truth < leave - 3 * STEP) | truth.isinf()) & (leave - enter > 4 * STEP)
    )
    clear &= truth.isfinite() | (at_floor > leave + 3 * STEP) | at_floor.isinf()
    found = met(rays, ball())
    t = first_of(found, len(rays))
    assert found.evaluations > len(found.t) > 300
    assert torch.equal(t.isfinite()[clear], truth.isfinite()[clear])
    both = clear & truth.isfinite()
    error = (t - truth)[both].abs()
    print(f"off by {error.quantile(0.95):.1e}, {found.evaluations / len(rays):.1f} evaluations a ray")
    assert float(error.quantile(0.95)) < 2e-5
    assert float(error.max()) < 1e-3  # along a ray that is nearly parallel to the floor
    assert 0.02 < float(below.double().mean()) < 0.9


@needs_kernels
@pytest.mark.parametrize("share", [1.0, 0.3])
def test_crossings_of_a_learnt_distance_are_those_of_float64(share: float) -> None:
    """Compiled in float32 against the readable form in float64, in all cells and in some of them."""
    known, rays = ball(0.02), rays_of()
    occupied = torch.rand(CELLS**3, generator=torch.Generator().manual_seed(4)) < share
    found = first_of(met(rays, known, occupied), len(rays))
    exact = in_double(rays)
    marched = march(exact, Occupancy(occupied, BOX.double(), CELLS), STEP, 0.0, None, 0.0)
    reach = partial(double(known).reach, safety=SAFETY)
    with torch.no_grad():
        truth = first_of(crossings(reach, exact, pieces_of(marched), SHORTEST), len(rays))
    both = found.isfinite() & truth.isfinite()
    apart = float((found.isfinite() != truth.isfinite()).double().mean())
    error = (found - truth)[both].abs()
    print(f"{int(both.sum())} rays; {apart:.4f} decided otherwise, 99 of 100 off by {error.quantile(0.99):.1e}")
    assert int(both.sum()) > 200
    assert apart < 0.01
    assert float(error.quantile(0.98)) < 1e-4


@needs_kernels
def test_edges_cover_the_same_share_as_in_the_readable_form() -> None:
    known, rays = ball(0.0, floor=False), rays_of(radii=True)
    exact = in_double(rays)
    cells = torch.ones(CELLS**3, dtype=torch.bool)
    marched = march(exact, Occupancy(cells, BOX.double(), CELLS), STEP, 0.0, None, 0.0)
    with torch.no_grad():
        truth = crossings(partial(double(known).reach, safety=SAFETY), exact, pieces_of(marched), SHORTEST)
    covered = [
        torch.zeros(len(rays), dtype=torch.float64).index_add(0, each.owners, each.coverage.double())
        for each in (met(rays, known), truth)
    ]
    assert int(((covered[1] > 0.02) & (covered[1] < 0.98)).sum()) > 5
    differ = (covered[0] - covered[1]).abs()
    assert float(differ.mean()) < 1e-3
    assert float((differ > 0.02).double().mean()) < 0.005


@needs_kernels
def test_a_ray_that_starts_inside_leaves_first() -> None:
    """A ray from inside the ball meets nothing, or the floor from above, as does one from outside."""
    origins = torch.tensor([[0.0, 0.0, 0.2], [0.0, 0.0, 0.2], [0.9, 0.0, 0.5]])
    directions = torch.tensor([[0.0, 0.0, 1.0], [0.8, 0.0, -0.6], [0.0, 0.6, -0.8]])
    found = met(Rays(origins, directions), ball())
    assert found.owners.tolist() == [1, 2]
    assert found.t.tolist() == pytest.approx([0.5 / 0.6, 1.0], abs=1e-5)


@needs_kernels
def test_broken_distances_show_and_no_rays_meet_nothing() -> None:
    known = ball()
    known.table.fill_(torch.nan)
    rays = rays_of(50)
    found = met(rays, known)
    assert len(found.t) > 20
    assert bool(found.t.isfinite().all())
    nothing = met(rays[:0], ball())
    assert (len(nothing.t), nothing.evaluations) == (0, 0)
    empty = met(rays, ball(), torch.zeros(CELLS**3, dtype=torch.bool))
    assert (len(empty.t), empty.evaluations) == (0, 0)


@needs_kernels
def test_crossings_have_the_same_bits_on_any_number_of_threads() -> None:
    before, found = torch.get_num_threads(), []
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            found.append(met(rays_of(5_000), ball(0.02)))
    finally:
        torch.set_num_threads(before)
    assert found[0].evaluations == found[1].evaluations
    assert all(torch.equal(a, b) for a, b in zip(found[0][:3], found[1][:3], strict=True))
