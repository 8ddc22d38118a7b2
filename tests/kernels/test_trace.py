"""A trace in one call against the march wave by wave: samples, densities and gradients."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from nerfloom.encodings.hash_grid import HashGrid
from nerfloom.fields.base import MLP
from nerfloom.fields.encoded import EncodedField
from nerfloom.fields.inverted import InvertedField
from nerfloom.geometry.points import Points
from nerfloom.geometry.rays import Rays, Samples
from nerfloom.kernels import dispatch
from nerfloom.kernels.march.occupancy import Occupancy
from nerfloom.kernels.march.waves import march
from nerfloom.kernels.traced.trace import TRACE, trace_reference
from nerfloom.samplers.occupancy import OccupancySampler
from tests.kernels.compiled import needs_kernels

BOX = torch.tensor([[-1.0, -1.5, -1.0], [1.0, 1.0, 2.0]])


class WaveByWave(EncodedField):
    """The same field, which says nothing of its density."""

    def grid_density(self) -> None:
        return None


def rays(count: int) -> Rays:
    origins = torch.randn(count, 3) * 3
    directions = torch.nn.functional.normalize(torch.randn(count, 3) * 0.5 - origins, dim=-1)
    return Rays(origins, directions)


def fields(sparse: bool, features: int) -> tuple[EncodedField, EncodedField]:
    made = []
    for kind in (EncodedField, WaveByWave):
        torch.manual_seed(3)
        field = kind(BOX, HashGrid(5, features, 4, 64, 10, sparse), width=32)
        with torch.no_grad():
            field.encoding.table.uniform_(-2, 2)
        made.append(field)
    return made[0], made[1]


def gradients(field: EncodedField, samples: Samples, factors: Tensor) -> list[Tensor]:
    factors = factors[: len(samples)]
    (torch.log1p(samples.sigma) * factors[:, 0] + (samples.features * factors[:, 1:]).sum(-1)).sum().backward()
    table, deferred = field.encoding.table, field.encoding.deferred
    own = torch.zeros_like(table) if table.grad is None else table.grad
    if deferred is not None and deferred.pending:
        deferred.add_to(own)
    return [own, *(weight.grad for weight in field.density_head.parameters())]


def rounding(field: EncodedField, lines: Rays, samples: Samples) -> Tensor:
    """(N, 17) by how much the logarithm of the density and the features may differ in bfloat16.

    Traces and waves round positions differently, in the last bit of float32: one multiplies and adds in C++, which
    rounds once or twice as the compiler likes, the other in torch. So an input or an activation that stands near the
    middle between two numbers of bfloat16 can become either, and these are up to 2^-7 of it apart. The bound is that
    all of them do, and all add up. Most values are not such a case and agree far better.
    """
    with torch.no_grad():
        first, second = field.density_head.parameters()
        inputs = field.encode(samples.positions(lines), None)
        hidden = (inputs @ first.T).relu()
        apart = 2**-7 * (inputs.abs() @ first.abs().T + hidden) @ second.abs().T
        return torch.cat([apart[:, :1], apart], -1)


@needs_kernels
@pytest.mark.parametrize("bfloat16", [False, True])
@pytest.mark.parametrize(
    ("count", "stop", "sparse", "features"), [(900, 1e-2, True, 2), (300, 0.0, False, 4), (1, 1e-4, True, 1)]
)
def test_a_trace_is_what_waves_give(count: int, stop: float, sparse: bool, features: int, bfloat16: bool) -> None:
    torch.manual_seed(0)
    sampler = OccupancySampler(BOX, 32, 200, stop)
    sampler.occupied = torch.rand(32**3) < 0.3
    found = []
    lines, factors = rays(count), torch.randn(100_000, 17)
    for field in fields(sparse, features):
        torch.manual_seed(1)
        with torch.autocast("cpu", torch.bfloat16, enabled=bfloat16):
            samples = sampler.sample(lines, field, jitter=True)
        found.append((samples, gradients(field, samples, factors)))
    (traced, own), (waves, expected) = found
    for name in ("t_starts", "t_ends", "offsets", "owners"):
        torch.testing.assert_close(getattr(traced, name), getattr(waves, name), rtol=2e-4, atol=2e-5)
    ours, theirs = (torch.cat([s.sigma.log()[:, None], s.features], -1).detach() for s in (traced, waves))
    off = (ours - theirs).abs()
    close = off <= (1e-3 + 2e-2 * theirs.abs() if bfloat16 else 2e-5 + 2e-4 * theirs.abs())
    if bfloat16:
        assert bool((off <= rounding(fields(sparse, features)[0], lines, waves)).all())
        assert float((~close).double().mean()) < 1e-4  # 4e-5 where the compiler multiplies and adds in two steps
    else:
        assert bool(close.all())
    for ours, theirs in zip(own, expected, strict=True):
        assert float((ours - theirs).norm()) <= (1e-2 if bfloat16 else 1e-4) * float(theirs.norm())
    assert len(traced) > count / 2


@needs_kernels
def test_densities_and_gradients_are_those_of_float64() -> None:
    torch.manual_seed(0)
    sampler, lines = OccupancySampler(BOX, 16, 100, 0.0), rays(200)
    field = fields(False, 2)[0]
    samples = sampler.sample(lines, field, jitter=False)
    factors = torch.randn(100_000, 17)
    own = gradients(field, samples, factors)
    exact = fields(False, 2)[0].double()
    exact_positions = samples.positions(lines).double()
    sigma, features = exact.density(Points(exact_positions))
    other = gradients(exact, samples.evaluated(sigma, features), factors.double())
    torch.testing.assert_close(samples.sigma.double(), sigma, rtol=1e-3, atol=1e-5)
    for ours, theirs in zip(own, other, strict=True):
        assert float((ours.double() - theirs).norm()) <= 1e-3 * float(theirs.norm())


@needs_kernels
def test_slices_of_time_boxes_and_nan_are_those_of_waves() -> None:
    torch.manual_seed(0)
    moving = replace(rays(300), times=torch.rand(300))
    for slices, levels, damaged in ((3, 1, False), (1, 2, False), (1, 1, True)):
        field, found = fields(False, 2)[0], []
        field.unbounded = levels > 1
        if damaged:
            with torch.no_grad():
                field.encoding.table[::50] = torch.nan
        density = field.grid_density()
        assert density is not None
        occupied = torch.rand(slices, levels * 16**3) < 0.3
        occupied[0] &= slices == 1
        occupancy = Occupancy(occupied.view(-1), BOX, 16, levels, slices)
        for run in (TRACE.implementations[0].run, trace_reference):
            with torch.no_grad():
                found.append(run(march(moving, occupancy, 0.03, 0.0, None, 1e-2), density))
        traced, waves = found
        for name in ("offsets", "owners", "t_starts", "t_ends", "sigma", "features"):
            ours, theirs = getattr(traced, name), getattr(waves, name)
            torch.testing.assert_close(ours, theirs, rtol=2e-4, atol=2e-5, equal_nan=True)
        counts = traced.offsets.diff()
        assert int(counts.sum()) > 100
        assert bool(traced.sigma.isnan().any()) == damaged
        if slices > 1:
            assert moving.times is not None
            assert not bool(counts[moving.times < 1 / 3].any())


@needs_kernels
def test_no_rays_no_cells_and_no_gradient() -> None:
    field = fields(True, 2)[0]
    sampler = OccupancySampler(BOX, 16, 100, 1e-3)
    assert len(sampler.sample(rays(0), field, jitter=False)) == 0
    with torch.no_grad():
        without = sampler.sample(rays(50), field, jitter=False)
    assert without.sigma is not None
    assert not without.sigma.requires_grad
    sampler.occupied = torch.zeros(16**3, dtype=torch.bool)
    empty = sampler.sample(rays(50), field, jitter=False)
    assert len(empty) == 0
    assert empty.offsets.tolist() == [0] * 51


def test_only_a_plain_field_says_what_its_density_is() -> None:
    field = fields(True, 2)[0]
    assert field.grid_density() is not None
    around = EncodedField(BOX, HashGrid(2, 2, 4, 8, 8), unbounded=True).grid_density()
    assert around is not None
    assert around.box is not None
    assert EncodedField(BOX, HashGrid(6, 2, 4, 8, 8, opening=True), opening=True).grid_density() is None
    assert EncodedField(BOX, HashGrid(2, 2, 4, 8, 8), ambient=2).grid_density() is None
    assert field.grid_color() is not None
    for network in (MLP(32, 16, 3, activation="sigmoid"), MLP(32, 16, 3, bias=False), MLP(20, 3, bias=False)):
        other = EncodedField(BOX, HashGrid(2, 2, 4, 8, 8))
        other.color_head = network
        assert other.grid_color() is None
    assert type("Own", (EncodedField,), {})(BOX, HashGrid(2, 2, 4, 8, 8)).grid_density() is None
    assert InvertedField(HashGrid(2, 2, 4, 8, 8)).grid_density() is None


@needs_kernels
def test_second_derivatives_go_wave_by_wave() -> None:
    torch.manual_seed(0)
    field, sampler = fields(False, 2)[0], OccupancySampler(BOX, 16, 100, 0.0)
    with dispatch.derivatives(2):
        samples = sampler.sample(rays(20), field, jitter=False)
        (once,) = torch.autograd.grad(samples.sigma.square().sum(), field.density_head[0].weight, create_graph=True)
        (twice,) = torch.autograd.grad(once.square().sum(), field.density_head[0].weight)
    assert float(twice.abs().sum()) > 0


@needs_kernels
def test_the_same_bits_on_any_number_of_threads() -> None:
    before, results = torch.get_num_threads(), []
    lines = rays(2000)
    try:
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            field = fields(True, 2)[0]
            samples = OccupancySampler(BOX, 32, 200, 1e-2).sample(lines, field, jitter=False)
            results.append(
                [samples.t_starts, samples.sigma, samples.features, *gradients(field, samples, torch.ones(400_000, 17))]
            )
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(a, b) for other in results[1:] for a, b in zip(results[0], other, strict=True))
