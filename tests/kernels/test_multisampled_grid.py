"""The hash grid at multisamples: compiled against reference, and both against look-ups of single points."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from nerfloom.encodings.multisampled import DECAYED, MultisampledHashGrid, _Decayed
from nerfloom.geometry.bounds import to_unit_box
from nerfloom.geometry.multisamples import fixed_pattern, hashed_pattern
from nerfloom.geometry.points import Frustums
from nerfloom.kernels.encodings.contraction import contract_to_unit_reference
from nerfloom.kernels.grids.hash_grid import hash_grid_reference
from nerfloom.kernels.grids.hash_grid_layout import HashGridLayout
from nerfloom.kernels.grids.hash_grid_lookup import TableGradient
from nerfloom.kernels.grids.multisampled_grid import LOOK_UP, multisampled_grid, multisampled_grid_reference
from nerfloom.kernels.grids.multisamples import (
    frustum_balls,
    frustum_balls_reference,
    unit_multisamples,
    unit_multisamples_reference,
)
from tests.kernels.compiled import needs_kernels, relative_error

LAYOUT = HashGridLayout.build(num_levels=4, base_resolution=4, max_resolution=300, log2_table_size=9)
BOX = torch.tensor([[-1.0, -2.0, -1.5], [1.0, 1.0, 2.5]])


def points(count: int, each: int, spread: float, seed: int = 0) -> Tensor:
    """Points (count, each, 4) around random places, some of them beyond the cube; deviations of 0 to many cells."""
    generator = torch.Generator().manual_seed(seed)
    centre = torch.rand(count, 1, 3, generator=generator) * 1.1 - 0.05
    around = centre + spread * torch.randn(count, each, 3, generator=generator)
    deviations = 10 ** (6 * torch.rand(count, each, 1, generator=generator) - 6)
    deviations[0] = 0
    return torch.cat([around, deviations], dim=-1)


def test_features_are_weighted_means_of_those_of_single_points() -> None:
    """The truth is computed in float64, with the weights by their formula."""
    x = points(30, 6, 0.05).double()
    table = torch.randn(LAYOUT.num_entries, 2, dtype=torch.float64)
    found = multisampled_grid(x, table, LAYOUT).view(30, 4, 2)
    single = hash_grid_reference(x[..., :3].reshape(-1, 3), table, LAYOUT).view(30, 6, 4, 2)
    cells = x[..., 3:] * torch.tensor(LAYOUT.resolutions, dtype=torch.float64)
    weights = torch.erf(1 / (8 * cells.clamp(min=1e-3).square()).sqrt())
    torch.testing.assert_close(found, (weights[..., None] * single).mean(1), rtol=1e-10, atol=1e-12)


def test_one_point_without_size_is_a_plain_look_up() -> None:
    x = points(30, 1, 0.0)
    x[..., 3] = 0
    table = torch.randn(LAYOUT.num_entries, 2)
    found, truth = multisampled_grid(x, table, LAYOUT), hash_grid_reference(x[:, 0, :3], table, LAYOUT)
    assert relative_error(found, truth) < 1e-6


@needs_kernels
@pytest.mark.parametrize("features", [1, 2, 4, 8])
@pytest.mark.parametrize(("each", "spread"), [(6, 1e-4), (6, 0.02), (6, 1.0), (1, 0.1), (3, 0.01)])
def test_compiled_values_and_gradients_are_the_references(each: int, spread: float, features: int) -> None:
    """Points share their cells at all levels, at some, or at none."""
    x, found = points(603, each, spread), []
    table = torch.randn(LAYOUT.num_entries, features, generator=torch.Generator().manual_seed(1))
    direction = torch.randn(603, 4 * features, generator=torch.Generator().manual_seed(2))
    direction[::3] = 0
    for form in (multisampled_grid, multisampled_grid_reference):
        p, t = x.clone().requires_grad_(), table.clone().requires_grad_()
        out = form(p, t, LAYOUT)
        found.append((out, *torch.autograd.grad((out * direction).sum(), (p, t))))
    for name, value, truth in zip(("value", "points' gradient", "table's gradient"), *found, strict=True):
        error = relative_error(value, truth)
        assert error < 1e-5, f"{name} is off by {error:.1e} of the largest"
    assert not found[0][1][..., 3].any()


@needs_kernels
def test_deferred_gradients_of_parts_with_different_numbers_of_points_are_the_dense_ones() -> None:
    torch.manual_seed(0)
    table = torch.randn(LAYOUT.num_entries, 4, requires_grad=True)
    deferred = TableGradient(LOOK_UP, LAYOUT)
    several, single = points(70, 6, 0.01), points(33, 1, 0.0, seed=1)
    loss = sum(multisampled_grid(x, table, LAYOUT, deferred).square().sum() for x in (several, single))
    loss.backward()
    assert table.grad is None
    assert sorted(len(x) for x, _ in deferred.parts) == [33, 70]
    loss = sum(multisampled_grid_reference(x, table, LAYOUT).square().sum() for x in (several, single))
    loss.backward()
    assert relative_error(deferred.summed(table.detach()), table.grad) < 1e-5
    assert deferred.parts == []


@needs_kernels
def test_a_step_of_adam_moves_the_entries_that_were_used() -> None:
    """They move by the learning rate against the sign of the gradient, as in any first step of Adam."""
    torch.manual_seed(0)
    grid = MultisampledHashGrid(4, 4, 4, 300, 9, sparse=True)
    assert grid.deferred is not None
    before = grid.table.detach().clone()
    x = points(20, 6, 0.01)
    direction = torch.randn(20, grid.num_features)
    (grid(x) * direction).sum().backward()
    moments = torch.zeros_like(before), torch.zeros_like(before), torch.zeros_like(before[:, 0])
    with torch.no_grad():
        updated = grid.deferred.adam(grid.table, *moments, 1e-2, (0.9, 0.99), 1e-15)
    table = before.requires_grad_()
    (grad,) = torch.autograd.grad((multisampled_grid_reference(x, table, grid.layout) * direction).sum(), table)
    used = (grad != 0).any(-1)
    assert updated == int(used.sum()) > 100
    clear = grad.abs() > 1e-5 * grad.abs().max()
    torch.testing.assert_close((grid.table - before)[clear], -1e-2 * grad.sign()[clear], rtol=1e-3, atol=0)
    assert torch.equal(grid.table[~used], before[~used])


def test_the_decay_is_the_gradient_of_the_mean_square_of_each_levels_features(monkeypatch: pytest.MonkeyPatch) -> None:
    """The mean over all choices of every eighth frustum has it; one choice does not change the other frustums."""
    torch.manual_seed(0)
    grids = [MultisampledHashGrid(4, 2, 4, 300, 9, decay=decay) for decay in (0.0, 0.1)]
    x = points(40, 6, 0.01)
    for grid in grids:
        torch.nn.init.normal_(grid.table, generator=torch.Generator().manual_seed(1))
    plain, decayed = (grid(x) for grid in grids)
    assert torch.equal(plain, decayed)
    (plain.sum() + 0.1 * plain.view(40, 4, 2).square().mean((0, 2)).sum()).backward()
    total, places = torch.zeros_like(grids[1].table), iter(range(DECAYED))
    monkeypatch.setattr(torch, "randint", lambda high, size: torch.tensor(next(places)))
    for place in range(DECAYED):
        features = grids[1](x).detach().requires_grad_()
        weighed = _Decayed.apply(features, 1.0)
        (grad,) = torch.autograd.grad(weighed, features, torch.zeros_like(features))
        assert grad.any(-1).nonzero().flatten().tolist() == list(range(place, 40, DECAYED))
    places = iter(range(DECAYED))
    for _ in range(DECAYED):
        (grad,) = torch.autograd.grad(grids[1](x).sum(), grids[1].table)
        total += grad / DECAYED
    assert grids[0].table.grad is not None
    assert relative_error(total, grids[0].table.grad) < 1e-6
    monkeypatch.setattr("nerfloom.base.device.runs_ahead", lambda device: True)  # elsewhere all decay at once
    (whole,) = torch.autograd.grad(grids[1](x).sum(), grids[1].table)
    assert relative_error(whole, grids[0].table.grad) < 1e-6
    grids[1].eval()
    still, truth = (torch.autograd.grad(grid(x).sum(), grid.table)[0] for grid in grids[::-1])
    assert torch.equal(still, truth)


def test_wrong_shapes_are_named() -> None:
    table = torch.randn(LAYOUT.num_entries, 2)
    for shape in ((5, 4), (5, 0, 4), (5, 6, 3)):
        with pytest.raises(ValueError, match=r"not \(N, J, 4\)"):
            multisampled_grid(torch.rand(shape), table, LAYOUT)
    with pytest.raises(ValueError, match="the table has shape"):
        multisampled_grid(torch.rand(5, 6, 4), table[1:], LAYOUT)
    assert multisampled_grid(torch.rand(0, 6, 4), table, LAYOUT).shape == (0, 8)


@needs_kernels
def test_nan_is_seen() -> None:
    for axis in range(4):
        x = points(5, 6, 0.01)
        x[2, 3, axis] = torch.nan
        found = multisampled_grid(x, torch.ones(LAYOUT.num_entries, 2), LAYOUT)
        assert found.isnan().any(-1).tolist() == [False, False, True, False, False]


# -- where the points are -----------------------------------------------------------------------------------------


def frustums(count: int) -> Frustums:
    generator = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    directions[:3] = torch.eye(3)
    starts = 10 ** (8 * torch.rand(count, generator=generator) - 4)
    starts[3:6] = 0
    ends = starts * (1 + torch.rand(count, generator=generator)) + 1e-3
    ends[6], ends[7] = 1e10, starts[7]
    origins = torch.randn(count, 3, generator=generator)
    return Frustums(origins, directions, starts, ends, 0.01 * torch.rand(count, generator=generator))


@needs_kernels
@pytest.mark.parametrize("contracted", [True, False])
def test_compiled_points_are_the_references(contracted: bool) -> None:
    torch.manual_seed(0)
    cones = frustums(203)
    for pattern in (fixed_pattern(cones), hashed_pattern(cones)):
        found = unit_multisamples(cones, pattern, BOX, contracted)
        double = Frustums(*(x.double() for x in vars(cones).values() if isinstance(x, Tensor)))
        turned = type(pattern)(*(x.double() for x in pattern))
        truth = unit_multisamples_reference(double, turned, BOX.double(), contracted)
        size = truth[..., :3].abs().amax((1, 2), keepdim=True).clamp(min=1)
        assert ((found[..., :3] - truth[..., :3]).abs() / size).max().item() < 2e-6
        torch.testing.assert_close(found[..., 3].double(), truth[..., 3], rtol=2e-5, atol=1e-30)


@needs_kernels
@pytest.mark.parametrize("contracted", [True, False])
def test_compiled_balls_are_the_references(contracted: bool) -> None:
    cones = frustums(203)
    double = Frustums(*(x.double() for x in vars(cones).values() if isinstance(x, Tensor)))
    found, truth = frustum_balls(cones, BOX, contracted), frustum_balls_reference(double, BOX.double(), contracted)
    size = truth[:, :3].abs().amax(1, keepdim=True).clamp(min=1)
    assert ((found[:, :3] - truth[:, :3]).abs() / size).max().item() < 2e-6
    torch.testing.assert_close(found[:, 3].double(), truth[:, 3], rtol=2e-5, atol=1e-30)


@pytest.mark.parametrize("contracted", [True, False])
def test_a_ball_has_the_mean_and_the_volume_of_points_in_its_frustum(contracted: bool) -> None:
    """Against the covariance of a million points, mapped to the cube; the frustum is small where space is bent."""
    generator = torch.Generator().manual_seed(0)
    direction = torch.nn.functional.normalize(torch.tensor([1.0, 2.0, -1.0]), dim=0)
    near, far, radius, count = (3.0, 3.1, 0.02, 1_000_000) if contracted else (0.5, 1.5, 0.3, 1_000_000)
    cone = Frustums(torch.zeros(1, 3), direction[None], *(torch.tensor([x]) for x in (near, far, radius)))
    # Uniform in the volume: the cube of the distance, and the square of the distance from the axis.
    u, v, angle = torch.rand(3, count, dtype=torch.float64, generator=generator)
    t = (near**3 + (far**3 - near**3) * u) ** (1 / 3)
    away, turn = radius * t * v.sqrt(), 2 * torch.pi * angle
    axis = direction.double()
    first = torch.nn.functional.normalize(torch.linalg.cross(axis, torch.eye(3, dtype=torch.float64)[0]), dim=0)
    second = torch.linalg.cross(axis, first)
    x = t[:, None] * axis + (away * turn.cos())[:, None] * first + (away * turn.sin())[:, None] * second
    to_unit = contract_to_unit_reference if contracted else to_unit_box
    unit = to_unit(x, BOX.double())
    deviation = unit.T.cov().det() ** (1 / 6)
    found = frustum_balls(cone, BOX, contracted)[0].double()
    torch.testing.assert_close(found[:3], unit.mean(0), rtol=0, atol=1e-3)
    assert found[3].item() == pytest.approx(deviation.item(), rel=0.01)


def gradients_of_rays(form: str, cones: Frustums, box: Tensor, contracted: bool) -> tuple[Tensor, Tensor]:
    """The gradients by origins and directions, along a random direction of the values of frustums, in one form."""
    origins, directions = (x.clone().requires_grad_() for x in (cones.origins, cones.directions))
    learnt = replace(cones, origins=origins, directions=directions)
    if "ball" in form:
        out = (frustum_balls if form == "ball" else frustum_balls_reference)(learnt, box, contracted)
    else:
        out = (unit_multisamples if form == "points" else unit_multisamples_reference)(
            learnt, fixed_pattern(replace(cones, ranks=torch.arange(len(cones)))), box, contracted
        )
    weights = torch.randn(out.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    found = torch.autograd.grad((out * weights).sum(), (origins, directions))
    return found[0], found[1]


@needs_kernels
@pytest.mark.parametrize("contracted", [True, False])
@pytest.mark.parametrize("form", ["points", "ball"])
def test_compiled_gradients_of_learnt_rays_are_the_references(form: str, contracted: bool) -> None:
    """Near the camera and 10,000 times as far away as the box, and in all directions."""
    cones = frustums(203)
    found = gradients_of_rays(form, cones, BOX, contracted)
    double = Frustums(*(x.double() for x in vars(cones).values() if isinstance(x, Tensor)))
    truth = gradients_of_rays(f"{form} reference", double, BOX.double(), contracted)
    for name, ours, exact in zip(("origins", "directions"), found, truth, strict=True):
        size = exact.abs().amax(1, keepdim=True)
        assert size.min().item() > 0, name
        assert ((ours - exact).abs() / size).max().item() < 2e-4, name


@pytest.mark.parametrize("form", ["points", "ball"])
def test_learnt_rays_move_what_stands_for_their_frustums(form: str) -> None:
    cones = frustums(10)
    origins = cones.origins.clone().requires_grad_()
    learnt = replace(cones, origins=origins)
    if form == "ball":
        x, each = frustum_balls(learnt, BOX, False), 1
    else:
        x, each = unit_multisamples(learnt, fixed_pattern(cones), BOX, False), 6
    (grad,) = torch.autograd.grad(x.sum(), origins)
    torch.testing.assert_close(grad, (each / (BOX[1] - BOX[0])).expand(10, 3))
