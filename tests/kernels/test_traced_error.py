"""The error of traced rays and its gradient in one call, against single operations and float64."""

from dataclasses import replace
from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from nerfloom.encodings.hash_grid import HashGrid
from nerfloom.fields.appearance import Appearance
from nerfloom.fields.encoded import EncodedField
from nerfloom.geometry.rays import Rays
from nerfloom.kernels import dispatch
from nerfloom.kernels.march.occupancy import Occupancy
from nerfloom.kernels.march.waves import March, march
from nerfloom.kernels.traced.colors import GridColor
from nerfloom.kernels.traced.squared_error import (
    TRACED_ERROR,
    PixelTargets,
    TracedError,
    traced_error,
    traced_error_reference,
)
from nerfloom.kernels.traced.trace import GridDensity, trace
from tests.kernels.compiled import needs_kernels

BOX = torch.tensor([[-1.0, -1.5, -1.0], [1.0, 1.0, 2.0]])
pytestmark = needs_kernels


class Case(NamedTuple):
    """The settings that differ between comparisons."""

    rays: int = 600
    rays_per_pixel: int = 1
    weighted: bool = False
    features: int = 2
    bands: int = 4
    sparse: bool = False
    stop: float = 1e-2
    slices: int = 1
    levels: int = 1


CASES = [
    Case(),
    Case(rays_per_pixel=4, weighted=True, sparse=True),
    Case(rays=597, rays_per_pixel=3, features=4, bands=0, stop=0.0),
    Case(rays=500, rays_per_pixel=250, features=8, bands=2),
    Case(rays=1, features=1, bands=1),
    Case(slices=3, weighted=True),
    Case(levels=2, sparse=True),
]


def rays(count: int) -> Rays:
    origins = torch.randn(count, 3) * 3
    directions = torch.nn.functional.normalize(torch.randn(count, 3) * 0.5 - origins, dim=-1)
    return Rays(origins, directions, times=torch.rand(count))


def field_of(case: Case) -> EncodedField:
    torch.manual_seed(3)
    grid = HashGrid(5, case.features, 4, 64, 10, case.sparse)
    field = EncodedField(BOX, grid, width=32, direction_levels=case.bands)
    with torch.no_grad():
        field.encoding.table.uniform_(-2, 2)
    return field


def marched(case: Case, lines: Rays) -> March:
    torch.manual_seed(4)
    occupied = torch.rand(case.slices * case.levels * 32**3) < 0.2
    occupancy = Occupancy(occupied, BOX, 32, case.levels, case.slices)
    return march(lines, occupancy, 0.02, 0.01 if case.levels > 1 else 0.0, torch.rand(len(lines)), case.stop)


def pixels_of(case: Case) -> PixelTargets:
    torch.manual_seed(5)
    count = case.rays // case.rays_per_pixel
    return PixelTargets(torch.rand(case.rays, 3), torch.rand(count, 3), torch.rand(count) if case.weighted else None)


def parts(field: EncodedField) -> tuple[GridDensity, GridColor]:
    density, color = field.grid_density(), field.grid_color()
    assert density is not None
    assert color is not None
    return density, color


def gradients(field: EncodedField) -> list[Tensor]:
    table, deferred = field.encoding.table, field.encoding.deferred
    own = torch.zeros_like(table) if table.grad is None else table.grad.clone()
    if deferred is not None and deferred.pending:
        deferred.add_to(own)
    weights = (*field.density_head.parameters(), *field.color_head.parameters())
    return [own, *(torch.zeros_like(weight) if weight.grad is None else weight.grad for weight in weights)]


def learnt(
    case: Case, thin: float = 0.0, compiled: bool = True, factor: float = 1.0
) -> tuple[TracedError, list[Tensor]]:
    torch.manual_seed(0)
    field = field_of(case)
    torch.manual_seed(1)
    march_of, (density, color), pixels = marched(case, rays(case.rays)), parts(field), pixels_of(case)
    if compiled:
        tensors = (march_of.rays.origins, density.table, *density.weights, *color.weights, *pixels)
        assert TRACED_ERROR.choose(tensors, march_of, density, color, pixels, thin).backend.name == "c++"
    torch.manual_seed(6)
    run = traced_error if compiled else traced_error_reference
    found = run(march_of, density, color, pixels, thin)
    (factor * found.error).backward()
    return found, gradients(field)


def assert_near(ours: list[Tensor], theirs: list[Tensor], error: float) -> None:
    for own, other in zip(ours, theirs, strict=True):
        assert float((own.double() - other.double()).norm()) <= error * float(other.norm())


@pytest.mark.parametrize("bfloat16", [False, True])
@pytest.mark.parametrize("case", CASES, ids=str)
def test_value_and_gradient_are_those_of_single_operations(case: Case, bfloat16: bool) -> None:
    with torch.autocast("cpu", torch.bfloat16, enabled=bfloat16):
        (ours, own), (theirs, expected) = (learnt(case, compiled=compiled) for compiled in (True, False))
    assert ours.num_samples == theirs.num_samples > case.rays / 2
    torch.testing.assert_close(ours.error, theirs.error, rtol=1e-5, atol=1e-7)
    torch.testing.assert_close(ours.rgb, theirs.rgb, rtol=1e-4, atol=1e-5)
    # bfloat16 rounds gradients that differ in their last float32 bits.
    assert_near(own, expected, 3e-3 if bfloat16 else 2e-5)


@pytest.mark.parametrize("case", CASES[:4], ids=str)
def test_value_and_gradient_are_those_of_float64(case: Case) -> None:
    """The truth uses the same samples."""
    found, own = learnt(case)
    torch.manual_seed(0)
    field = field_of(case)
    torch.manual_seed(1)
    march_of, pixels = marched(case, rays(case.rays)), pixels_of(case)
    with torch.no_grad():
        known = trace(march_of, parts(field)[0])
    exact = field_of(case).double()
    lines = replace(march_of.rays, **{n: getattr(march_of.rays, n).double() for n in ("origins", "directions")})
    positions = lines.points(known.owners, (known.t_starts.double() + known.t_ends.double()) / 2)
    sigma, features = parts(exact)[0].at(positions)
    rgb = exact.color(features, lines.directions[known.owners]).double()
    colors = []
    for ray, (first, last) in enumerate(zip(known.offsets[:-1].tolist(), known.offsets[1:].tolist(), strict=True)):
        tau = sigma[first:last] * (known.t_ends - known.t_starts)[first:last].double()
        weights = torch.exp(-(tau.cumsum(0) - tau)) * -torch.expm1(-tau)
        behind = (1 - weights.sum()) * pixels.background[ray].double()
        colors.append((weights[:, None] * rgb[first:last]).sum(0) + behind)
    mean = torch.stack(colors).view(len(pixels.target), -1, 3).mean(1)
    squares = (mean - pixels.target.double()).square()
    error = (squares if pixels.weights is None else squares * pixels.weights.double()[:, None]).mean()
    error.backward()
    torch.testing.assert_close(found.error.double(), error.detach(), rtol=1e-5, atol=1e-8)
    torch.testing.assert_close(found.rgb.double(), mean.detach(), rtol=1e-4, atol=1e-5)
    assert_near(own, gradients(exact), 5e-3)  # a rounded position may be on the other side of a ReLU


def test_the_gradient_goes_on_from_what_comes_in() -> None:
    for case in CASES[:2]:
        (_, once), (_, other) = learnt(case), learnt(case, factor=-3.0)
        assert_near(other, [-3 * grad for grad in once], 1e-6)


def test_samples_are_left_out_without_changing_the_mean() -> None:
    case = Case(rays=256)
    exact, grads = learnt(case)
    torch.manual_seed(1)
    lines = rays(case.rays)
    field, pixels, found = field_of(case), pixels_of(case), list[list[Tensor]]()
    for seed in range(200):
        march_of = marched(case, lines)
        torch.manual_seed(seed)
        error = traced_error(march_of, *parts(field), pixels, 1.0).error
        assert torch.equal(error, exact.error)
        error.backward()
        found.append([grad.clone() for grad in gradients(field)])
        for parameter in field.parameters():
            parameter.grad = None
    for number, true in enumerate(grads):
        values = torch.stack([each[number] for each in found]).double()
        deviation = values.std(0) / len(values) ** 0.5
        assert float((values[0] - true).norm()) > 1e-3 * float(true.norm())
        assert float((values.mean(0) - true).norm()) < 1.5 * float(deviation.norm())


def test_what_is_left_out_is_the_seeds() -> None:
    case = CASES[1]
    (_, first), (_, again) = learnt(case, 1.0), learnt(case, 1.0)
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))


def test_nan_is_seen() -> None:
    for damaged in ("density", "color"):
        case, field = Case(), field_of(Case())
        with torch.no_grad():
            getattr(field, f"{damaged}_head")[0].weight[0, 0] = torch.nan
        for thin in (0.0, 0.5):
            found = traced_error(marched(case, rays(case.rays)), *parts(field), pixels_of(case), thin)
            assert bool(found.error.isnan())
            found.error.backward()
            assert not all(bool(each.isfinite().all()) for each in gradients(field))


def test_rays_without_samples_show_the_background() -> None:
    case, field = Case(rays=90), field_of(Case())
    lines, pixels = rays(90), pixels_of(Case(rays=90))
    away = replace(lines, directions=-lines.directions, origins=lines.origins * 10)
    nowhere = march(lines, Occupancy(torch.zeros(32**3, dtype=torch.bool), BOX, 32), 0.02, 0.0, None, 1e-2)
    for march_of in (marched(case, away), nowhere):
        found = traced_error(march_of, *parts(field), pixels, 0.5)
        found.error.backward()
        assert found.num_samples == 0
        torch.testing.assert_close(found.rgb, pixels.background)
        torch.testing.assert_close(found.error, (pixels.background - pixels.target).square().mean())
        assert not any(bool(each.any()) for each in gradients(field))


def test_the_same_bits_on_any_number_of_threads() -> None:
    before, results = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            found, grads = learnt(Case(rays=3000, sparse=True), 0.5)
            results.append([found.error, found.rgb, *grads])
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(a, b) for other in results[1:] for a, b in zip(results[0], other, strict=True))


def test_what_has_other_gradients_goes_operation_by_operation() -> None:
    case = Case(rays=20)
    field, pixels = field_of(case), pixels_of(case)
    background = pixels.background.clone().requires_grad_()
    traced_error(marched(case, rays(20)), *parts(field), pixels._replace(background=background)).error.backward()
    assert background.grad is not None
    assert float(background.grad.abs().sum()) > 0
    with torch.no_grad():
        found = traced_error(marched(case, rays(20)), *parts(field), pixels)
    assert not found.error.requires_grad
    with dispatch.derivatives(2):
        error = traced_error(marched(case, rays(20)), *parts(field), pixels).error
        (once,) = torch.autograd.grad(error, field.color_head[0].weight, create_graph=True)
        (twice,) = torch.autograd.grad(once.square().sum(), field.color_head[0].weight)
    assert float(twice.abs().sum()) > 0


def test_only_a_plain_field_says_what_its_colour_is() -> None:
    field = field_of(Case())
    assert field.grid_color() is not None
    assert EncodedField(BOX, HashGrid(2, 2, 4, 8, 8), appearance=Appearance(4, 3)).grid_color() is None
    assert EncodedField(BOX, HashGrid(6, 2, 4, 8, 8, opening=True), opening=True).grid_color() is None
    assert type("Own", (EncodedField,), {})(BOX, HashGrid(2, 2, 4, 8, 8)).grid_color() is None
