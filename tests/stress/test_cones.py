"""Cones: the Gaussians of conical frustums against exact moments and Monte Carlo, thin, far and without length."""

import math
from fractions import Fraction

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from nerfloom.geometry.points import conical_frustums, sample_points
from nerfloom.geometry.rays import Rays, Samples
from nerfloom.samplers.uniform import LAST_INTERVAL
from tests.stress.backends import FEW

F64 = torch.float64
DRAWS = 400_000
ENDS = [(0.0, 1.0), (0.0, 1e-3), (0.5, 0.75), (2.0, 6.0), (100.0, 100.01), (1e4, 3e4)]
"""Where frustums begin and end: cones with their apex, short and long ones, thin slices, far away."""
RADII = [1e-6, 1e-3, 0.3]
"""Radii of a cone at distance 1: for a telephoto lens, a usual pixel, a wide cone."""


def drawn_in_frustum(start: float, end: float, radius: float, generator: torch.Generator) -> Tensor:
    """Points (N, 3) drawn evenly in a frustum around z, float64: draws in the cylinder around it that lie within."""
    t = start + (end - start) * torch.rand(DRAWS, generator=generator, dtype=F64)
    across = radius * end * (2 * torch.rand(DRAWS, 2, generator=generator, dtype=F64) - 1)
    within = across.norm(dim=-1) < radius * t
    return torch.cat([across, t[:, None]], dim=-1)[within]


def exact_moments(start: float, end: float, radius: float) -> tuple[Fraction, Fraction, Fraction]:
    """Mean distance, variance along the axis and across it, by integrals of t^2 dt, without cancellation."""
    a, b, r = Fraction(start), Fraction(end), Fraction(radius)
    if a == b:
        return a, Fraction(0), r * r * a * a / 4
    volume = (b**3 - a**3) / 3
    mean, square = (b**4 - a**4) / 4 / volume, (b**5 - a**5) / 5 / volume
    return mean, square - mean * mean, r * r * square / 4


def assert_like(found: Tensor, draws: Tensor, spread: Tensor) -> None:
    """Check that a mean over draws (N, ...) equals `found`, within five standard errors."""
    assert bool(((draws.mean(0) - found).abs() <= 5 * spread / math.sqrt(len(draws))).all())


@pytest.mark.entry(10)
@pytest.mark.parametrize("radius", RADII)
@pytest.mark.parametrize(("start", "end"), ENDS)
def test_a_frustums_gaussian_has_the_moments_of_points_drawn_in_it(start: float, end: float, radius: float) -> None:
    draws = drawn_in_frustum(start, end, radius, torch.Generator().manual_seed(0))
    assert len(draws) > DRAWS / 5
    mean, along, across = (
        moment[0] for moment in conical_frustums(*(torch.tensor([x], dtype=F64) for x in (start, end, radius)))
    )
    apart = draws - draws.mean(0)
    assert_like(mean, draws[:, 2], draws[:, 2].std())
    assert_like(along, apart[:, 2] ** 2, (apart[:, 2] ** 2).std())
    for axis in (0, 1):
        assert_like(across, apart[:, axis] ** 2, (apart[:, axis] ** 2).std())


@pytest.mark.entry(10)
@pytest.mark.parametrize("dtype", [torch.float32, F64])
@pytest.mark.parametrize("radius", RADII)
@pytest.mark.parametrize(("start", "end"), [*ENDS, (100.0, 100.0), (0.0, 0.0), (1.0, LAST_INTERVAL), (0.0, 1e15)])
def test_a_frustums_moments_are_exact_to_rounding(start: float, end: float, radius: float, dtype: torch.dtype) -> None:
    """The variance along the axis from 100 to 100.01 is 8.3e-6, which E[t^2] - E[t]^2 loses in float32."""
    given_ends = torch.tensor([start, end, radius], dtype=dtype)
    found = [moment.item() for moment in conical_frustums(*given_ends[:, None])]
    truth = [float(moment) for moment in exact_moments(*given_ends.tolist())]
    assert found == pytest.approx(truth, rel=1e-5 if dtype == torch.float32 else 1e-12, abs=0)


@pytest.mark.entry(10)
@FEW
@given(
    start=st.one_of(st.just(0.0), st.floats(-20, 9).map(lambda exponent: 10.0**exponent)),
    length=st.one_of(st.just(0.0), st.floats(-20, 10).map(lambda exponent: 10.0**exponent)),
    radius=st.sampled_from([0.0, 1e-7, 1e-3, 1.0]),
)
def test_no_variance_is_negative_or_nan(start: float, length: float, radius: float) -> None:
    """This holds in float32 for any interval: as long as rounding leaves it, empty, or without end."""
    ends = torch.tensor([[start], [start + length], [radius]])
    mean, along, across = (moment.item() for moment in conical_frustums(*ends))
    first, last = ends[0].item(), ends[1].item()
    assert first * (1 - 1e-6) <= mean <= last * (1 + 1e-6)
    assert 0 <= along <= ((last - first) / 2) ** 2 * (1 + 1e-5)
    assert 0 <= across <= (radius * last / 2) ** 2 * (1 + 1e-5) + 1e-37


@pytest.mark.entry(10)
def test_a_frustum_without_length_at_the_origin_has_a_gradient() -> None:
    """Rays that miss a box have such frustums, and poses may be learnt."""
    ends = torch.zeros(2, requires_grad=True)
    sum(conical_frustums(ends[:1], ends[1:], torch.ones(1))).sum().backward()
    assert ends.grad is not None
    assert bool(ends.grad.isfinite().all())


# -- points with a size -------------------------------------------------------------------------------------------


def two_rays(radii: Tensor | None) -> tuple[Rays, Samples]:
    """An oblique ray with two intervals and one along -y with three; their points are not their middles; float64."""
    directions = torch.nn.functional.normalize(torch.tensor([[1.0, -2.0, 0.5], [0.0, -1.0, 0.0]], dtype=F64), dim=-1)
    origins = torch.tensor([[0.1, 0.2, 0.3], [5.0, 0.0, -1.0]], dtype=F64)
    rays = Rays(origins, directions, torch.zeros(2, dtype=F64), torch.full((2,), 9.0, dtype=F64), radii)
    starts, lengths = torch.tensor([0.0, 3.0, 1.0, 2.0, 4.0], dtype=F64), torch.tensor([2.0, 0.5, 1.0, 1.5, 2.0])
    return rays, Samples(starts, starts + lengths, torch.tensor([0, 2, 5]), starts + 0.25 * lengths)


@pytest.mark.entry(10)
def test_a_points_gaussian_is_that_of_its_cone_in_space() -> None:
    """Mean and the covariance's diagonal of points drawn in each frustum and turned to its ray."""
    radii, generator = torch.tensor([0.2, 0.01], dtype=F64), torch.Generator().manual_seed(1)
    rays, samples = two_rays(radii)
    points = sample_points(rays, samples, "gaussian")
    assert points.covariances is not None
    assert points.covariances.shape == (5, 3)
    for index, owner in enumerate([0, 0, 1, 1, 1]):
        axis = rays.directions[owner]
        basis = torch.linalg.svd(axis[None]).Vh  # the last two are across the axis
        ends = samples.t_starts[index].item(), samples.t_ends[index].item()
        local = drawn_in_frustum(*ends, radii[owner].item(), generator)
        draws = rays.origins[owner] + local[:, :2] @ basis[1:] + local[:, 2:] * axis
        apart = draws - draws.mean(0)
        assert_like(points.positions[index], draws, draws.std(0) + 1e-12)
        assert_like(points.covariances[index], apart**2, (apart**2).std(0) + 1e-12)


@pytest.mark.entry(10)
def test_a_points_radius_is_its_cones_where_the_field_is_asked() -> None:
    rays, samples = two_rays(torch.tensor([0.2, 0.01], dtype=F64))
    plain, sized = sample_points(rays, samples), sample_points(rays, samples, "radius")
    torch.testing.assert_close(plain.positions, samples.positions(rays))
    torch.testing.assert_close(sized.positions, plain.positions)
    assert (plain.radii, plain.covariances, sized.covariances) == (None, None, None)
    assert sized.radii is not None
    assert sized.radii.tolist() == pytest.approx([0.2 * 0.5, 0.2 * 3.125, 0.01 * 1.25, 0.01 * 2.375, 0.01 * 4.5])


@pytest.mark.entry(10)
def test_points_know_their_times_whatever_their_size() -> None:
    rays, samples = two_rays(torch.ones(2))
    moving = Rays(rays.origins, rays.directions, rays.nears, rays.fars, rays.pixel_radii, torch.tensor([0.25, 0.75]))
    for footprint in ("none", "radius", "gaussian"):
        assert sample_points(rays, samples, footprint).times is None
        times = sample_points(moving, samples, footprint).times
        assert times is not None
        assert times.tolist() == [0.25] * 2 + [0.75] * 3


@pytest.mark.entry(10)
def test_a_size_is_refused_where_rays_have_none() -> None:
    rays, samples = two_rays(None)
    assert len(sample_points(rays, samples)) == 5
    for footprint in ("radius", "gaussian"):
        with pytest.raises(ValueError, match="the rays need pixel_radii"):
            sample_points(rays, samples, footprint)
