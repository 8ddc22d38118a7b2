"""Samples of a shape plus a network: compiled against the reference in float64, the reference against differences."""

import pytest
import torch
from torch import Tensor

from nerfloom.kernels.surfaces.samples import (
    NO_FLOOR,
    FirstShape,
    Intervals,
    first_distance,
    surface_samples,
    surface_samples_reference,
    unit_normals,
    unit_normals_reference,
)
from tests.kernels.compiled import needs_kernels, relative_error

OUTPUTS = 5
SLOPES = 1.0, 30.0, 1e3, 1e5
HEADINGS = {"head-on": -1.0, "grazing": -1e-3, "along": 0.0, "leaving": 0.7, "any": None}
"""Cosine between a ray and the direction away from the ball's centre."""


def given(
    slope: float, cosine: float | None = None, count: int = 403
) -> tuple[Tensor, Tensor, Tensor, FirstShape, Intervals]:
    """Samples around a ball on a floor; the radius is some widths of the surface, so that all opacities occur."""
    torch.manual_seed(0)
    outward = torch.nn.functional.normalize(torch.randn(count, 3), dim=-1)
    across = torch.nn.functional.normalize(torch.linalg.cross(outward, torch.randn(count, 3)), dim=-1)
    share = torch.rand(count, 1) * 2 - 1 if cosine is None else torch.full((count, 1), cosine)
    directions = share * outward + (1 - share.square()).sqrt() * across
    size = 20 / slope
    centre, scale = torch.tensor([0.1, -0.2, 0.3]) * size, torch.tensor([0.5, 0.4, 0.6]) / size
    positions = centre + outward * size * (1 + torch.randn(count, 1) / 4)
    network = torch.randn(count, OUTPUTS + 3) / 10
    lengths = size * torch.rand(count)
    floor = torch.tensor([0.0, 0.6, 0.8, -0.5 * size])
    shape = FirstShape(centre, scale, size, size, 1e-3 * size, floor)
    return network, torch.tensor(slope), positions, shape, Intervals(directions, lengths)


def double(values: tuple) -> tuple:
    network, slope, positions, shape, intervals = values
    shape = shape._replace(centre=shape.centre.double(), scale=shape.scale.double(), floor=shape.floor.double())
    if intervals is not None:
        intervals = intervals._replace(directions=intervals.directions.double(), lengths=intervals.lengths.double())
    return network.double(), slope.double(), positions.double(), shape, intervals


def results(run: object, values: tuple) -> tuple[Tensor, ...]:
    """Opacity or density, features, and the gradients of a loss of both by network and sharpness."""
    network, slope = (each.clone().requires_grad_() for each in values[:2])
    stopping, features = run(network, slope, *values[2:])  # type: ignore[operator]
    torch.manual_seed(1)
    factors = torch.rand(len(stopping)), torch.randn(features.shape)
    loss = (stopping * factors[0].to(stopping)).sum() / values[1] + (features * factors[1].to(features)).mean()
    by_network, by_slope = torch.autograd.grad(loss, [network, slope])
    # The network's unit grows with the surface's width, and the distance's gradient does not.
    parts = by_network[:, :1], by_network[:, 1:-3], by_network[:, -3:]
    return stopping.detach(), features.detach(), *parts, by_slope


@needs_kernels
@pytest.mark.parametrize("annealing", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("slope", SLOPES)
@pytest.mark.parametrize("heading", HEADINGS)
def test_opacities_equal_the_reference(slope: float, heading: str, annealing: float) -> None:
    *rest, intervals = given(slope, HEADINGS[heading])
    values = (*rest, intervals._replace(annealing=annealing))
    truths = results(surface_samples_reference, double(values))
    errors = [relative_error(a, b) for a, b in zip(results(surface_samples, values), truths, strict=True)]
    print(" ".join(f"{each:.0e}" for each in errors))
    assert max(errors) < 2e-5


@needs_kernels
@pytest.mark.parametrize("slope", SLOPES)
def test_densities_equal_the_reference(slope: float) -> None:
    values = (*given(slope)[:-1], None)
    truths = results(surface_samples_reference, double(values))
    for value, truth in zip(results(surface_samples, values), truths, strict=True):
        assert relative_error(value, truth) < 2e-5


@needs_kernels
def test_opacities_far_from_any_surface_are_finite() -> None:
    """Widths of a millionth of the scene: the opacity is 0 or 1, and nothing overflows."""
    network, _, positions, shape, intervals = given(1.0)
    for slope in (1e3, 1e6, 1e9):
        found = results(surface_samples, (network, torch.tensor(slope), positions, shape, intervals))
        assert all(bool(each.isfinite().all()) for each in found)
        assert bool(((found[0] >= 0) & (found[0] <= 1)).all())


@needs_kernels
def test_what_is_not_asked_for_has_no_gradient() -> None:
    """Rows without a gradient are exactly 0: the network's backward pass leaves them out. And no rows at all."""
    network, slope, positions, shape, intervals = given(30.0)
    leaf = network.clone().requires_grad_()
    stopping, features = surface_samples(leaf, slope, positions, shape, intervals)
    (found,) = torch.autograd.grad(stopping[:7].sum() + features[:7].sum(), leaf)
    assert bool(found[:7].any(-1).all())
    assert not found[7:].any()
    (alone,) = torch.autograd.grad(surface_samples(leaf, slope, positions, shape, intervals)[1].sum(), leaf)
    assert not alone[:, 0].any()
    none = Intervals(intervals.directions[:0], intervals.lengths[:0])
    stopping, features = surface_samples(leaf[:0], slope, positions[:0], shape, none)
    assert stopping.shape == (0,)
    assert features.shape == (0, OUTPUTS + 5)


def test_the_reference_has_the_gradient_of_its_values() -> None:
    network, slope, positions, shape, intervals = double(given(30.0, count=6))
    leaves = [each.clone().requires_grad_() for each in (network, slope, positions)]
    for along in (None, intervals, intervals._replace(annealing=0.3)):
        assert torch.autograd.gradcheck(lambda *of: surface_samples_reference(*of, shape, along), leaves)  # noqa: B023


def test_the_first_shape_is_the_union_of_a_ball_and_a_half_space() -> None:
    """Without a network: the smaller of the two distances, and its gradient; a ball alone without a floor."""
    _, _, positions, shape, _ = double(given(1.0))
    network = torch.zeros(len(positions), OUTPUTS + 3, dtype=torch.float64)
    away = positions - shape.centre
    ball = (away.square().sum(-1) + shape.rounding**2).sqrt() - shape.radius
    height = (positions * shape.floor[:3]).sum(-1) - shape.floor[3]
    distances, gradients = first_distance(network, positions, shape)
    torch.testing.assert_close(distances, torch.minimum(ball, height))
    on_floor = height < ball
    assert 0.05 < float(on_floor.double().mean()) < 0.95
    torch.testing.assert_close(gradients[on_floor], shape.floor[:3].expand(int(on_floor.sum()), 3))
    alone = shape._replace(floor=torch.tensor(NO_FLOOR, dtype=torch.float64))
    torch.testing.assert_close(first_distance(network, positions, alone)[0], ball)


def test_the_first_shape_keeps_its_digits_under_autocast() -> None:
    """Which rounds products of matrices to bfloat16."""
    network, _, positions, shape, _ = given(1.0)
    truth = first_distance(network, positions, shape)
    with torch.autocast("cpu", torch.bfloat16):
        found = first_distance(network, positions, shape)
    assert all(torch.equal(one, other) for one, other in zip(found, truth, strict=True))


@needs_kernels
def test_gradients_become_unit_vectors() -> None:
    """Gradients may have any length, 0 too; the other features stay."""
    torch.manual_seed(0)
    features = torch.randn(300, 8) * torch.logspace(-6, 6, 300)[:, None]
    features[5, :3] = 0
    pulls = torch.randn(300, 8)
    found = []
    for run, kind in ((unit_normals, torch.float32), (unit_normals_reference, torch.float64)):
        leaf = features.to(kind).requires_grad_()
        out = run(leaf)
        (grad,) = torch.autograd.grad((out * pulls.to(kind)).sum(), leaf)
        found.append((out.detach(), grad * features[:, :3].norm(dim=-1, keepdim=True)))
    for value, truth in zip(*found, strict=True):
        assert relative_error(value[:, :3], truth[:, :3]) < 1e-6
        assert relative_error(value[:, 3:], truth[:, 3:]) < 1e-6
    assert not found[0][0][5, :3].any()
