"""Where samples go: histograms with nothing in them, rays without end, cells' faces."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from nerfloom.fields.base import Field
from nerfloom.geometry.bounds import half_edge
from nerfloom.geometry.points import Points
from nerfloom.geometry.rays import Rays
from nerfloom.kernels.histograms.intervals import resample
from nerfloom.kernels.histograms.inverse_cdf import inverse_cdf
from nerfloom.kernels.histograms.spacing import spacing
from nerfloom.kernels.march.occupancy import Occupancy
from nerfloom.kernels.march.waves import CompiledMarch, ReferenceMarch
from nerfloom.rendering.volume import VolumeRenderer
from nerfloom.samplers.proposal import ENDLESS_FAR, ProposalSampler, interlevel_loss
from tests.kernels.test_march import walk
from tests.stress.backends import COMPILED, FEW, backends

BOX = torch.tensor([[-1.0] * 3, [1.0] * 3])
BIN = st.tuples(st.sampled_from([0.0, 1e-30, 1e-10, 1e-3, 1.0]), st.sampled_from([0.0, 0.25, 1.0]))
"""Weight and width of a bin."""
HISTOGRAMS = st.tuples(st.integers(1, 6), st.integers(0, 3)).flatmap(
    lambda shape: st.tuples(
        st.just(shape[0]),
        st.lists(st.lists(BIN, min_size=shape[0], max_size=shape[0]), min_size=shape[1], max_size=shape[1]),
    )
)
"""Number of bins of a ray, and the bins of each ray."""

Bins = list[tuple[float, float]]


# -- inverse transform --------------------------------------------------------------------------------------------


def histogram(bins: int, rays: list[Bins]) -> tuple[Tensor, Tensor]:
    """Edges (R, B + 1), which float32 holds exactly, and weights (R, B)."""
    weights, widths = (torch.tensor([[part[i] for part in ray] for ray in rays]).view(len(rays), bins) for i in (0, 1))
    return torch.cat([torch.zeros(len(rays), 1), widths.cumsum(-1)], dim=-1), weights


def mass_below(edges: list[float], masses: list[float], x: float) -> tuple[float, float]:
    """Bounds of the mass below x: they differ by the mass of bins without width at x."""
    low = high = 0.0
    for left, right, mass in zip(edges[:-1], edges[1:], masses, strict=True):
        share = min(max((x - left) / (right - left), 0.0), 1.0) if right > left else None
        low += mass * (float(left < x) if share is None else share)
        high += mass * (float(left <= x) if share is None else share)
    return low, high


def assert_quantiles(edges: list[float], masses: list[float], found: list[float], shares: list[float]) -> None:
    """Check that the mass below each found position equals its share, and that all lie within the edges."""
    total = math.fsum(masses)
    for x, share in zip(found, shares, strict=True):
        assert edges[0] <= x <= edges[-1]
        if total > 0:
            low, high = mass_below(edges, masses, x)
            assert low - 1e-5 * total <= share * total <= high + 1e-5 * total, (x, share)


@pytest.mark.entry(13)
@backends()
@FEW
@given(
    table=HISTOGRAMS,
    shift=st.sampled_from([0.0, 0.5, 1 - 2.0**-24]),
    count=st.integers(1, 9),
    power=st.sampled_from([1.0, 0.5]),
    padding=st.sampled_from([0.0, 0.01]),
)
def test_new_intervals_of_any_histogram(
    backend: str, table: tuple[int, list[Bins]], shift: float, count: int, power: float, padding: float
) -> None:
    """Without weight, with bins of no width, at both ends: quantiles of the mass in float64, sorted."""
    edges, weights = histogram(*table)
    found = resample(edges, weights, torch.full((len(edges),), shift), count, power, padding)
    assert found.shape == (len(edges), count + 1)
    assert bool((found.diff(dim=-1) >= -1e-6).all())
    shares = [(j + shift) / (count + 1) for j in range(count + 1)]
    for row, weight, places in zip(edges.tolist(), weights.tolist(), found.tolist(), strict=True):
        assert_quantiles(row, [w**power + padding for w in weight], places, shares)


@pytest.mark.entry(13)
@FEW
@given(
    table=HISTOGRAMS,
    u=st.lists(st.sampled_from([0.0, 2.0**-24, 0.25, 0.7, 1 - 2.0**-24, 1.0]), max_size=6),
    strided=st.booleans(),
)
def test_points_of_any_histogram(table: tuple[int, list[Bins]], u: list[float], strided: bool) -> None:
    """u = 0 and u = 1 are the ends of the mass; without weight all bins are alike."""
    edges, weights = histogram(*table)
    places = torch.tensor(u).expand(len(edges), len(u))
    if strided:
        edges, weights, places = (x.t().contiguous().t() for x in (edges, weights, places))
    found = inverse_cdf(edges, weights, places)
    assert found.shape == places.shape
    for row, weight, points in zip(edges.tolist(), weights.tolist(), found.tolist(), strict=True):
        assert_quantiles(row, [w + 1e-5 for w in weight], points, u)


@pytest.mark.entry(13)
@backends()
@pytest.mark.parametrize("padding", [0.0, 0.01])
def test_a_ray_whose_bins_all_stand_in_one_place(backend: str, padding: float) -> None:
    found = resample(torch.full((2, 4), 3.0), torch.tensor([[0.0] * 3, [0.2] * 3]), torch.rand(2), 5, 1.0, padding)
    assert found.tolist() == [[3.0] * 6] * 2


def new_edges_with_nan_at(place: int) -> Tensor:
    """New intervals of a histogram of three bins; one has a weight of NaN."""
    weights = torch.tensor([[0.2, 0.5, 0.3]])
    weights[0, place] = math.nan
    return resample(torch.tensor([[0.0, 1.0, 2.0, 3.0]]), weights, torch.tensor([0.5]), 4, 1.0, 0.01)


@pytest.mark.entry(12, 13)
@backends()
@pytest.mark.parametrize("place", [1, 2])
def test_nan_weights_are_seen_in_new_intervals(backend: str, place: int) -> None:
    assert bool(new_edges_with_nan_at(place).isnan().all())


@pytest.mark.entry(12, 13)
@backends()
def test_a_nan_weight_in_front_is_seen_in_new_intervals(backend: str) -> None:
    assert bool(new_edges_with_nan_at(0).isnan().all())


# -- rays that start at 0 and never end ---------------------------------------------------------------------------


class Ball(Field):
    """Half opaque, around the origin."""

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        return 2.0 * (points.positions.norm(dim=-1) < 0.7), points.positions

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        return torch.full_like(features, 0.5)


def some_rays(count: int, near: float, far: float) -> Rays:
    """Half of them from inside `BOX`."""
    generator = torch.Generator().manual_seed(0)
    origins = torch.randn(count, 3, generator=generator)
    origins = origins / origins.norm(dim=-1, keepdim=True) * torch.tensor([0.5, 3.0])[torch.arange(count) % 2, None]
    towards = torch.rand(count, 3, generator=generator) - 0.5 - origins
    directions = towards / towards.norm(dim=-1, keepdim=True)
    return Rays(origins, directions, torch.full((count,), near), torch.full((count,), far))


@pytest.mark.entry(14)
@backends()
@pytest.mark.parametrize("cone", [0.0, 1 / 64])
def test_marching_from_zero_to_infinity(backend: str, cone: float) -> None:
    """The box ends a ray, however far it might go; one that starts inside starts where it is."""
    kind = CompiledMarch if backend == COMPILED else ReferenceMarch
    grid = Occupancy(torch.ones(512, dtype=torch.bool), BOX, 8)
    endless, ended = (walk(kind(some_rays(20, 0.0, far), grid, 0.05, cone, None, 0.0)) for far in (math.inf, 100.0))
    assert endless[3].tolist() == ended[3].tolist()
    for one, other in zip(endless[:3], ended[:3], strict=True):
        torch.testing.assert_close(one, other)
    first = endless[0][endless[3][:-1][::2]]  # of the rays from inside
    assert not first.any()


@pytest.mark.entry(14)
@backends()
@pytest.mark.parametrize("endless", [False, True])
@pytest.mark.parametrize("jitter", [False, True])
@pytest.mark.parametrize("unbounded", [False, True])
def test_proposals_from_zero_to_infinity(backend: str, unbounded: bool, jitter: bool, endless: bool) -> None:
    """Even disparity begins at 0 without 1 / 0, and its last edge is finite: so are the picture and the gradients."""
    torch.manual_seed(0)
    sampler = ProposalSampler(BOX, (24, 12, 8), (16, 32), unbounded, endless, log2_table_size=10)
    sampler.train().update(0, Ball().density)
    rays = some_rays(16, 0.0, math.inf)
    found = VolumeRenderer().render(rays, sampler.sample(rays, Ball(), jitter), Ball(), torch.ones(3))
    samples = found.samples
    assert samples is not None
    assert found.weights is not None
    starts, ends, points = (samples.padded(t) for t in (samples.t_starts, samples.t_ends, samples.t))
    for values in (starts, ends, points, found.weights, found.rgb):
        assert bool(values.isfinite().all())
    assert bool((starts >= 0).all())
    assert bool((starts[:, 1:] == ends[:, :-1]).all())
    assert bool((ends >= starts).all())
    assert bool((points.diff(dim=-1) >= 0).all())
    if endless:
        assert bool((ends[:, -1] == ENDLESS_FAR).all())
    loss = interlevel_loss(samples, found.weights)
    loss.backward()
    assert math.isfinite(loss.item())
    gradients = [parameter.grad for parameter in sampler.parameters()]
    assert all(gradient is not None and bool(gradient.isfinite().all()) for gradient in gradients)


@pytest.mark.entry(14)
@pytest.mark.parametrize("far", [1.0, 1e3, 1e30, math.inf])
def test_normalised_distances_begin_and_end_with_the_ray(far: float) -> None:
    edges = torch.tensor([[0.0, 0.25, 0.5, 0.75, 1.0]])
    t = spacing(torch.zeros(1), torch.tensor([far]), scale=half_edge(BOX))(edges)[0]
    assert t[0] == 0
    assert bool(t.isfinite().all())
    assert bool((t.diff() > 0).all())
    if far < 1e6:
        assert t[-1].item() == pytest.approx(far, rel=1e-3)
    else:
        assert t[-1].item() > 1e6


# -- cells --------------------------------------------------------------------------------------------------------


def rays_along_faces() -> Rays:
    """Along every edge of 8^3 cells, exactly and next to it, from both sides, and through their corners."""
    lattice = torch.linspace(-1, 1, 9)
    across = torch.cartesian_prod(lattice, lattice)
    origins, directions = [], []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            for tilt in (0.0, 1e-6, -1e-6):
                origin = torch.empty(len(across), 3)
                origin[:, axis], origin[:, (axis + 1) % 3], origin[:, (axis + 2) % 3] = -3 * sign, *across.t()
                direction = torch.zeros(len(across), 3)
                direction[:, axis], direction[:, (axis + 1) % 3] = sign, tilt
                origins.append(origin)
                directions.append(direction)
    corners = torch.cat([across, lattice.new_full((len(across), 1), -1.0)], dim=-1)
    origins.append(corners - 1)
    directions.append(torch.full_like(corners, 3**-0.5))
    count = sum(map(len, origins))
    return Rays(torch.cat(origins), torch.cat(directions), torch.zeros(count), torch.full((count,), 100.0))


@pytest.mark.entry(5)
@backends()
@pytest.mark.parametrize("cone", [0.0, 1 / 64])
def test_no_sample_lies_in_an_empty_cell(backend: str, cone: float) -> None:
    """Whichever side of a face rounding puts a sample on: it is at most a thousandth of a cell from an occupied one."""
    occupied = torch.rand(8**3, generator=torch.Generator().manual_seed(0)) < 0.2
    rays, grid = rays_along_faces(), Occupancy(occupied, BOX, 8)
    kind = CompiledMarch if backend == COMPILED else ReferenceMarch
    starts, ends, owners, _ = walk(kind(rays, grid, 0.05, cone, None, 0.0))
    middles = (starts + ends).double() / 2
    positions = rays.origins[owners].double() + middles[:, None] * rays.directions[owners].double()
    touching = torch.zeros(len(owners), dtype=torch.bool)
    for aside in torch.cartesian_prod(*[torch.tensor([-1e-3, 1e-3])] * 3):
        x, y, z = ((positions + 1) * 4 + aside).floor().long().clamp(0, 7).unbind(-1)
        touching |= occupied.view(8, 8, 8)[x, y, z]
    assert len(owners) > 1000
    assert bool(touching.all())
    assert bool((positions.abs() <= 1 + 1e-5).all())
