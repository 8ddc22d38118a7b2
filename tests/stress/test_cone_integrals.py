"""Integrals over cones: roots of covariances, their contraction and the integrated encoding, against float64 draws."""

import math

import pytest
import torch
from torch import Tensor

from nerfloom.encodings.integrated import IntegratedEncoding, icosahedron_directions, integrated_encoding
from nerfloom.geometry.bounds import contract, contract_gaussians, contraction_scale
from nerfloom.geometry.multisamples import Pattern
from nerfloom.geometry.points import Frustums, Points, frames, sample_points
from nerfloom.geometry.rays import Rays, Samples
from nerfloom.kernels.encodings.frequency import frequency_encoding_reference
from nerfloom.kernels.grids.downweighting import level_weights
from nerfloom.kernels.grids.hash_grid_layout import HashGridLayout
from nerfloom.kernels.grids.multisampled_grid import multisampled_grid
from nerfloom.kernels.grids.multisamples import unit_multisamples
from nerfloom.samplers.proposal import ENDLESS_FAR
from tests.stress.backends import backends
from tests.stress.test_cones import assert_like, drawn_in_frustum, two_rays

F64 = torch.float64
DRAWS = 200_000
BOX = torch.tensor([[-1.0, -2.0, -1.0], [1.0, 2.0, 3.0]], dtype=F64)


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=F64)


def directions(count: int) -> Tensor:
    """Unit vectors (count, 3), the axes and their opposites first, where frames and contractions could be singular."""
    axes = torch.cat([torch.eye(3, dtype=F64), -torch.eye(3, dtype=F64)])
    return torch.cat([axes, torch.nn.functional.normalize(normal(count - 6, 3), dim=-1)])


# -- Gaussians in space ------------------------------------------------------------------------------------------------


@pytest.mark.entry(10)
@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_frames_are_rotations_whose_first_column_is_the_axis(dtype: torch.dtype) -> None:
    near_pole = torch.tensor([[1e-8, 0.0, -1.0], [0.0, 1e-20, -1.0], [-1e-4, 1e-4, -1 + 1e-8]], dtype=F64)
    axes = torch.cat([directions(200), torch.nn.functional.normalize(near_pole, dim=-1)]).to(dtype)
    found = frames(axes)
    assert torch.equal(found[:, :, 0], axes)
    tolerance = 1e-6 if dtype == torch.float32 else 1e-12
    torch.testing.assert_close(
        found.mT @ found, torch.eye(3, dtype=dtype).expand(len(axes), 3, 3), atol=tolerance, rtol=0
    )
    torch.testing.assert_close(torch.linalg.det(found), torch.ones(len(axes), dtype=dtype), atol=tolerance, rtol=0)


@pytest.mark.entry(10)
def test_roots_are_of_the_covariance_of_points_drawn_in_the_cone() -> None:
    radii, generator = torch.tensor([0.2, 0.01], dtype=F64), torch.Generator().manual_seed(1)
    rays, samples = two_rays(radii)
    points = sample_points(rays, samples, "gaussian")
    assert points.covariances is not None
    roots = points.roots()
    covariances = roots @ roots.mT
    torch.testing.assert_close(covariances.diagonal(dim1=1, dim2=2), points.covariances)
    for index, owner in enumerate([0, 0, 1, 1, 1]):
        axis = rays.directions[owner]
        ends = samples.t_starts[index].item(), samples.t_ends[index].item()
        local = drawn_in_frustum(*ends, radii[owner].item(), generator)
        apart = local[:, :2] @ torch.linalg.svd(axis[None]).Vh[1:] + local[:, 2:] * axis
        apart = apart - apart.mean(0)
        products = apart[:, :, None] * apart[:, None]
        assert_like(covariances[index], products, products.std(0) + 1e-12)


@pytest.mark.entry(10)
def test_points_without_a_gaussian_have_no_roots_and_get_a_ball() -> None:
    points = Points(torch.zeros(4, 3))
    with pytest.raises(ValueError, match="no Gaussians"):
        points.roots()
    sized = points.sized(0.5)
    torch.testing.assert_close(sized.roots() @ sized.roots().mT, (0.25 * torch.eye(3)).expand(4, 3, 3))
    assert sized.sized(7.0) is sized


# -- contraction -------------------------------------------------------------------------------------------------------


def around() -> Tensor:
    """Positions in the unit ball, on its border and beyond, on axes and between."""
    return torch.cat([directions(12) * distance for distance in (0.0, 0.3, 0.999, 1.0, 1.001, 1.5, 7.0, 300.0)])


@pytest.mark.entry(9)
@pytest.mark.entry(10)
def test_gaussians_are_contracted_by_the_derivative_of_the_contraction() -> None:
    means = around()
    roots = torch.eye(3, dtype=F64).expand(len(means), 3, 3)
    found, derivative = contract_gaussians(means, roots)
    torch.testing.assert_close(found, contract(means))
    truth = torch.stack([torch.autograd.functional.jacobian(contract, mean) for mean in means])
    smooth = (means.norm(dim=-1) - 1).abs() > 1e-6  # on the border there are two, the identity and the one outside
    torch.testing.assert_close(derivative[smooth], truth[smooth], atol=1e-12, rtol=1e-9)
    torch.testing.assert_close(contraction_scale(means), torch.linalg.det(derivative) ** (1 / 3))


@pytest.mark.entry(10)
@pytest.mark.parametrize("distance", [0.5, 1.5, 4.0, 60.0])
def test_contracted_gaussians_have_the_moments_of_contracted_draws(distance: float) -> None:
    """Gaussians that are small compared with their distance, so that the derivative is exact; elongated and oblique."""
    means = directions(10) * distance
    roots = 1e-4 * distance * frames(directions(10).flip(0)) * torch.tensor([1.0, 0.2, 0.2], dtype=F64)
    found, contracted = contract_gaussians(means, roots)
    draws = contract(means[:, None] + normal(1, DRAWS, 3) @ roots.mT)
    apart = draws - draws.mean(1, keepdim=True)
    sampled = (apart.mT @ apart) / DRAWS
    scale = sampled.diagonal(dim1=1, dim2=2).sum(-1)
    assert ((draws.mean(1) - found).norm(dim=-1) < 5 * (scale / DRAWS).sqrt() + 1e-6 * scale.sqrt()).all()
    error = (contracted @ contracted.mT - sampled).abs().amax((1, 2))
    print(f"contracted covariances: off {DRAWS:,} draws by {(error / scale).max():.1e} of their traces")
    assert (error < (6 / math.sqrt(DRAWS) + 1e-3) * scale).all()


@pytest.mark.entry(9)
@pytest.mark.entry(10)
def test_far_gaussians_keep_their_precision_in_float32() -> None:
    """A cone's last interval: from 1,000 to 10^10, a standard deviation of 10^9 along, which contracts to 10^-10."""
    axes = directions(40)
    rays = Rays(0.3 * directions(40).roll(1, 0), axes, pixel_radii=torch.full((40,), 1e-3, dtype=F64))
    samples = Samples.regular(torch.full((40, 1), 1e3, dtype=F64), torch.full((40, 1), ENDLESS_FAR, dtype=F64))
    outcome = []
    for dtype in (torch.float32, F64):
        some = Rays(
            *(value.to(dtype) for value in (rays.origins, axes)), pixel_radii=torch.full((40,), 1e-3, dtype=dtype)
        )
        kept = Samples(samples.t_starts.to(dtype), samples.t_ends.to(dtype), samples.offsets, per_ray=1)
        points = sample_points(some, kept, "gaussian")
        mean, root = contract_gaussians(points.positions, points.roots())
        outcome.append((mean.double(), root.square().sum(-1).sqrt().double()))
    (mean, deviation), (true_mean, true_deviation) = outcome
    torch.testing.assert_close(mean, true_mean, atol=1e-6, rtol=0)
    torch.testing.assert_close(deviation, true_deviation, atol=1e-6, rtol=1e-3)
    assert true_deviation.max() < 2e-3


# -- encoding ----------------------------------------------------------------------------------------------------------


@pytest.mark.entry(10)
def test_the_encoding_is_the_mean_over_draws_and_so_is_its_gradient() -> None:
    """Means, variances and their gradients, each draw with parameters of its own; 5 standard errors."""
    means = torch.tensor([[0.3, -1.2, 4.0], [0.0, 2.5, -0.1]], dtype=F64, requires_grad=True)
    deviations = torch.tensor([[0.5, 0.01, 0.2], [1e-3, 0.1, 1.0]], dtype=F64, requires_grad=True)
    found = integrated_encoding(means, deviations.square(), 5)
    count = DRAWS // 4
    each = [values.detach().expand(count, 2, 3).clone().requires_grad_() for values in (means, deviations)]
    drawn = frequency_encoding_reference(each[0] + each[1] * normal(count, 2, 3), 5, include_input=False)
    print(f"integrated encoding: off the mean of {count:,} draws by {(found - drawn.mean(0)).abs().max():.1e}")
    assert_like(found, drawn, drawn.std(0) + 1e-12)
    seeds = torch.where(normal(*found.shape, seed=2) > 0, 1.0, -1.0).to(F64)
    exact = torch.autograd.grad((found * seeds).sum(), (means, deviations))
    for gradient, sampled in zip(exact, torch.autograd.grad((drawn * seeds).sum(), each), strict=True):
        assert_like(gradient, sampled, sampled.std(0) + 1e-12)


@pytest.mark.entry(10)
def test_the_encoding_of_points_is_the_frequency_encoding() -> None:
    x = 3 * normal(50, 4)
    found = integrated_encoding(x, torch.zeros_like(x), 10)
    torch.testing.assert_close(found, frequency_encoding_reference(x, 10, include_input=False))


@pytest.mark.entry(1)
@pytest.mark.entry(10)
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float32, F64])
def test_wide_gaussians_have_no_waves_and_finite_gradients(dtype: torch.dtype) -> None:
    means = torch.tensor([[0.0, 1e4, -1e9], [2.0, 2.0, 2.0]], dtype=dtype, requires_grad=True)
    variances = torch.tensor([[1e20, 1e30, torch.inf], [0.0, 1e-40, 1e-12]], dtype=dtype, requires_grad=True)
    found = integrated_encoding(means, variances, 16)
    assert found.dtype == (F64 if dtype == F64 else torch.float32)
    assert found[0].eq(0).all()
    assert bool(found.isfinite().all())
    found.sum().backward()
    assert means.grad is not None
    assert variances.grad is not None
    assert bool(means.grad.isfinite().all())
    assert bool(variances.grad.isfinite().all())


@pytest.mark.medium
@pytest.mark.entry(10)
@pytest.mark.parametrize("contracted", [False, True])
@pytest.mark.parametrize("along", [None, icosahedron_directions().double()])
def test_the_encoding_of_cones_is_the_mean_over_points_in_them(contracted: bool, along: Tensor | None) -> None:
    """Compared with means over the frustums' points, which Gaussians approximate, for waves longer than the
    frustums."""
    radii, generator = torch.tensor([0.02, 0.01], dtype=F64), torch.Generator().manual_seed(1)
    rays, samples = two_rays(radii)
    encoding = IntegratedEncoding(BOX, 2, 1e-3, contracted, along).double()
    found = encoding(sample_points(rays, samples, "gaussian"))
    assert found.shape == (5, encoding.num_features)
    for index, owner in enumerate([0, 0, 1, 1, 1]):
        start, end = samples.t_starts[index].item(), samples.t_ends[index].item()
        if end - start > (0.6 if contracted else 1.6):  # the derivative at the mean stands for all of it
            continue
        axis = rays.directions[owner]
        local = drawn_in_frustum(start, end, radii[owner].item(), generator)
        across = local[:, :2] @ torch.linalg.svd(axis[None]).Vh[1:]
        drawn = rays.origins[owner] + across + local[:, 2:] * axis
        unit = (drawn - BOX.mean(0)) / (BOX[1] - BOX[0]) * 2
        unit = contract(unit) if contracted else unit
        waves = frequency_encoding_reference(unit if along is None else unit @ along.mT, 2, include_input=False)
        error = (waves.mean(0) - found[index]).abs().max()
        print(f"encoding of a cone: off the mean over points drawn in it by {error:.1e}")
        assert error < 0.03


@pytest.mark.entry(10)
def test_directions_between_the_axes_tell_needles_from_balls() -> None:
    """Along the axes, a needle in the direction (1, 1, 1) looks like a ball: mip-NeRF 360, figure 3."""
    axis = torch.ones(1, 3, dtype=F64) / 3**0.5
    needle = Points(torch.zeros(1, 3, dtype=F64), axes=axis, variances=torch.tensor([[0.3, 1e-6]], dtype=F64))
    ball = Points(torch.zeros(1, 3, dtype=F64)).sized(0.1**0.5)
    box = torch.tensor([[-1.0] * 3, [1.0] * 3], dtype=F64)
    # `sample_points` computes these covariances along the axes for such an axis: a third of 0.3 each.
    needle = Points(needle.positions, axes=axis, variances=needle.variances, covariances=ball.covariances)
    along_axes, between = (
        IntegratedEncoding(box, 3, 1.0, False, each).double() for each in (None, icosahedron_directions())
    )
    torch.testing.assert_close(along_axes(needle), along_axes(ball), atol=1e-6, rtol=0)
    assert (between(needle) - between(ball)).abs().max() > 0.1


@pytest.mark.entry(10)
def test_the_directions_are_those_of_an_icosahedron_divided_once() -> None:
    found = icosahedron_directions().double()
    assert found.shape == (21, 3)
    torch.testing.assert_close(found.norm(dim=-1), torch.ones(21, dtype=F64))
    cosines = (found @ found.mT).abs().fill_diagonal_(0)
    # The nearest are a corner and the middle of its edge, half of the 63.43 degrees between corners.
    assert math.degrees(math.acos(cosines.max().item())) == pytest.approx(math.degrees(math.atan(2)) / 2, abs=1e-4)
    torch.testing.assert_close(found.mT @ found, 7 * torch.eye(3, dtype=F64), atol=1e-6, rtol=0)  # the same in each


@pytest.mark.entry(10)
def test_levels_of_a_grid_count_by_the_share_of_draws_in_a_cell() -> None:
    deviations, resolutions = torch.tensor([0.0, 1e-3, 1e-2, 0.3], dtype=F64), torch.tensor([4, 64, 1024])
    draws = normal(DRAWS, 1) * deviations
    found = level_weights(deviations, resolutions)
    for level, cells in enumerate(resolutions.tolist()):
        within = (draws.abs() < 0.5 / cells).double()
        error = (found[:, level] - within.mean(0)).abs().max()
        print(f"weights of a level of {cells} cells: off the share of draws by {error:.1e}")
        assert_like(found[:, level], within, within.std(0) + 1e-9)


# -- compiled: the points of a cone, and a grid that is looked up at them ----------------------------------------------


def some_cones(count: int, generator: torch.Generator) -> Frustums:
    """Frustums (float32) in the box, short and long, narrow and wide."""
    axes = directions(count + 6)[6:]
    starts = 0.2 + 0.3 * torch.rand(count, generator=generator, dtype=F64)
    ends = starts * (1 + torch.rand(count, generator=generator, dtype=F64))
    radii = 10 ** (-3 + 2.5 * torch.rand(count, generator=generator, dtype=F64))
    origins = torch.tensor([0.0, 0.0, 1.0], dtype=F64) - 0.5 * axes
    return Frustums(*(values.float() for values in (origins, axes, starts, ends, radii)))


def drawn_in(cones: Frustums, index: int, generator: torch.Generator) -> Tensor:
    """Points (N, 3) drawn evenly in one of the frustums, in the unit cube of BOX, float64."""
    double = [values[index].double() for values in (cones.origins, cones.directions, cones.t_starts, cones.t_ends)]
    local = drawn_in_frustum(double[2].item(), double[3].item(), cones.radii[index].item(), generator)
    across = local[:, :2] @ torch.linalg.svd(double[1][None]).Vh[1:]
    return (double[0] + across + local[:, 2:] * double[1] - BOX[0]) / (BOX[1] - BOX[0])


@pytest.mark.entry(10)
@backends()
def test_the_points_of_a_cone_have_the_moments_of_draws(backend: str) -> None:
    """Mean and covariance over all rotations of the pattern; float32 beside five standard errors."""
    generator = torch.Generator().manual_seed(4)
    cones, turns = some_cones(6, generator), 8
    each = [Pattern(torch.full((6,), 2 * math.pi * turn / turns), torch.ones(6)) for turn in range(turns)]
    found = torch.stack([unit_multisamples(cones, pattern, BOX.float(), False)[..., :3] for pattern in each], 1)
    points = found.flatten(1, 2).double()
    mean = points.mean(1)
    apart = points - mean[:, None]
    for index in range(6):
        draws = drawn_in(cones, index, generator)
        around = draws - draws.mean(0)
        products, error = around[:, :, None] * around[:, None], 5 / math.sqrt(len(draws))
        covariance = apart[index].mT @ apart[index] / len(apart[index])
        off = (mean[index] - draws.mean(0)).abs(), (covariance - products.mean(0)).abs()
        print(f"{backend}: points of a cone: mean off draws by {off[0].max():.1e}, covariance by {off[1].max():.1e}")
        assert bool((off[0] < error * draws.std(0) + 1e-6).all())
        assert bool((off[1] < error * products.std(0) + 1e-7).all())


@pytest.mark.entry(10)
@backends()
def test_a_grid_of_a_linear_function_shows_its_mean_over_a_cone(backend: str) -> None:
    """Value, and gradient by the function: interpolation is exact there, and a coarse level's weight is 1."""
    generator = torch.Generator().manual_seed(5)
    cones, layout = some_cones(5, generator), HashGridLayout.build(1, 2, 2, 8)
    vertices = torch.cartesian_prod(*[torch.arange(3) / 2] * 3)
    slope = torch.tensor([[0.5, -1.0, 2.0], [1.0, 3.0, -0.3]], requires_grad=True)
    points = unit_multisamples(cones, Pattern(torch.rand(5, generator=generator), torch.ones(5)), BOX.float(), False)
    points[..., 3] *= 1e-3
    table = torch.zeros(layout.num_entries, 2)
    table[: len(vertices)] = vertices @ slope.T
    found = multisampled_grid(points, table, layout)
    sums = [torch.autograd.grad(values.sum(), slope, retain_graph=True)[0] for values in found]
    for index in range(5):
        draws = drawn_in(cones, index, generator)
        shown = draws @ slope.detach().double().T
        error = 5 / math.sqrt(len(draws))
        assert bool(((found[index] - shown.mean(0)).abs() < error * shown.std(0) + 1e-5).all())
        assert bool(((sums[index] - draws.mean(0)).abs() < error * draws.std(0) + 1e-5).all())
