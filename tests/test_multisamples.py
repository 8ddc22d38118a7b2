"""Multisamples of conical frustums against the frustums' moments, and the effect of a contraction on their size."""

import math

import pytest
import torch
from torch import Tensor

from nerfloom.geometry.bounds import contract, contraction_scale
from nerfloom.geometry.multisamples import (
    NUM_MULTISAMPLES,
    Pattern,
    fixed_pattern,
    hashed_pattern,
    multisamples,
)
from nerfloom.geometry.points import Frustums, conical_frustums, frames, sample_points
from nerfloom.geometry.rays import Rays, Samples

F64 = torch.float64
ENDS = torch.tensor([[0.0, 1.0], [0.0, 1e-3], [0.5, 0.75], [2.0, 6.0], [100.0, 100.01], [1e4, 3e4]], dtype=F64)


def unit(count: int, dtype: torch.dtype = F64) -> Tensor:
    generator = torch.Generator().manual_seed(count)
    return torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=dtype), dim=-1)


def frustums(radius: float, dtype: torch.dtype = F64) -> Frustums:
    ends = ENDS.to(dtype)
    origins = torch.linspace(-1, 1, 3 * len(ends), dtype=dtype).view(-1, 3)
    return Frustums(origins, unit(len(ends), dtype), ends[:, 0], ends[:, 1], torch.full_like(ends[:, 0], radius))


def turned(angle: float, mirror: float) -> Pattern:
    return Pattern(torch.full((len(ENDS),), angle, dtype=F64), torch.full((len(ENDS),), mirror, dtype=F64))


def covariances(positions: Tensor) -> Tensor:
    apart = positions - positions.mean(1, keepdim=True)
    return apart.mT @ apart / positions.shape[1]


@pytest.mark.parametrize("radius", [1e-3, 0.3])
@pytest.mark.parametrize("mirror", [1.0, -1.0])
@pytest.mark.parametrize("angle", [0.0, math.pi / 6, 2.0])
def test_mean_and_variances_are_the_frustums(radius: float, mirror: float, angle: float) -> None:
    """The mean, the variance along the axis, and the sum of the variances across it agree for every rotation."""
    cones = frustums(radius)
    mean_t, along, perpendicular = conical_frustums(cones.t_starts, cones.t_ends, cones.radii)
    positions, _ = multisamples(cones, turned(angle, mirror))
    assert positions.shape == (len(ENDS), NUM_MULTISAMPLES, 3)
    mean = cones.origins + mean_t[:, None] * cones.directions
    scale = cones.t_ends[:, None]
    assert ((positions.mean(1) - mean).abs() / scale).max().item() < 1e-12
    found = covariances(positions)
    on_axis = torch.einsum("ni,nij,nj->n", cones.directions, found, cones.directions)
    torch.testing.assert_close(on_axis, along, rtol=1e-6, atol=0)  # of 1e-11 of the distance, from 100 to 100.01
    beside = found.diagonal(dim1=1, dim2=2).sum(-1) - on_axis
    torch.testing.assert_close(beside, 2 * perpendicular, rtol=1e-8, atol=0)


@pytest.mark.parametrize("radius", [1e-3, 0.3])
def test_the_mean_covariance_over_rotations_is_the_frustums(radius: float) -> None:
    cones = frustums(radius)
    _, along, perpendicular = conical_frustums(cones.t_starts, cones.t_ends, cones.radii)
    turns = [turned(2 * math.pi * step / 8, 1.0) for step in range(8)]
    found = torch.stack([covariances(multisamples(cones, pattern)[0]) for pattern in turns]).mean(0)
    axis = cones.directions[:, :, None] @ cones.directions[:, None]
    truth = along[:, None, None] * axis + perpendicular[:, None, None] * (torch.eye(3, dtype=F64) - axis)
    largest = torch.maximum(along, perpendicular)
    assert ((found - truth).abs().amax((1, 2)) / largest).max().item() < 1e-6


def test_a_points_deviation_is_half_its_distance_from_the_axis_and_points_lie_in_order() -> None:
    """Within the frustum, but the last point of a cone with its apex: 3 % of the length beyond the end."""
    cones = frustums(0.3)
    positions, deviations = multisamples(cones, fixed_pattern(cones))
    apart = positions - cones.origins[:, None]
    t = (apart * cones.directions[:, None]).sum(-1)
    away = (apart - t[..., None] * cones.directions[:, None]).norm(dim=-1)
    torch.testing.assert_close(away, 0.3 * t / math.sqrt(2), rtol=1e-8, atol=0)
    torch.testing.assert_close(deviations, away / 2, rtol=1e-8, atol=0)
    assert bool((t.diff(dim=1) > 0).all())
    assert bool((t > cones.t_starts[:, None]).all())
    beyond = ((t[:, -1] - cones.t_ends) / (cones.t_ends - cones.t_starts)).tolist()
    assert beyond[:2] == pytest.approx([(3 / math.sqrt(7) - 1) / 4] * 2, rel=1e-6)
    assert max(beyond) < 0.034


@pytest.mark.parametrize(
    ("start", "end"), [(0.0, 0.0), (3.0, 3.0), (0.0, 1e-30), (1.0, 1e10), (0.0, 1e15), (1e9, 1e10)]
)
def test_frustums_without_length_and_without_end_are_finite_with_finite_gradients(start: float, end: float) -> None:
    ends = torch.tensor([start, end], requires_grad=True)
    directions = torch.tensor([[0.0, 0.0, -1.0]], requires_grad=True)
    cones = Frustums(torch.zeros(1, 3), directions, ends[:1], ends[1:], torch.full((1,), 1e-3))
    positions, deviations = multisamples(cones, fixed_pattern(cones))
    assert start <= positions[0, 0, 2].abs().item() * (1 + 1e-6)
    assert positions[0, -1, 2].abs().item() <= end * 1.034
    (positions.sum() + deviations.sum()).backward()
    for tensor in (positions, deviations, ends.grad, directions.grad):
        assert tensor is not None
        assert bool(tensor.isfinite().all())


def test_in_evaluation_each_second_pattern_is_the_mirror_image_turned_by_30_degrees() -> None:
    one = frustums(0.3)
    twice = Frustums(
        *(torch.stack([x[3], x[3]]) for x in vars(one).values() if isinstance(x, torch.Tensor)),
        ranks=torch.tensor([4, 5]),
    )
    positions, _ = multisamples(twice, fixed_pattern(twice))
    _, first, second = frames(twice.directions).unbind(-1)
    apart = positions - twice.origins[:, None]
    angles = torch.atan2((apart * second[:, None]).sum(-1), (apart * first[:, None]).sum(-1)).rad2deg() % 360
    for found, truth in zip(angles, ([0, 120, 240, 180, 300, 60], [330, 210, 90, 150, 30, 270]), strict=True):
        difference = (found - torch.tensor(truth, dtype=F64) + 180) % 360 - 180
        assert difference.abs().max().item() < 1e-9


@pytest.mark.parametrize("starts", ["anywhere", "along a ray", "far", "all the same"])
def test_hashed_patterns_are_evenly_turned_and_half_of_them_mirrored(starts: str) -> None:
    """This holds for all starts: of rays that begin anywhere, of small steps from one place, far away, and of rays that
    differ only in the ends of the first intervals."""
    torch.manual_seed(0)
    t = {"anywhere": 2 + 4 * torch.rand(40_000), "along a ray": 2.1 + 1e-4 * torch.arange(40_000)}
    t["far"], t["all the same"] = 1e6 * t["anywhere"], torch.zeros(40_000)
    empty = torch.empty(40_000, 3)
    ends = 0.1 * torch.rand(40_000) if starts == "all the same" else t[starts] + 0.1
    cones = Frustums(empty, empty, t[starts], ends, ends)
    turns, mirrors = hashed_pattern(cones)
    assert all(torch.equal(again, first) for again, first in zip(hashed_pattern(cones), (turns, mirrors), strict=True))
    assert set(mirrors.tolist()) == {-1.0, 1.0}
    assert abs(mirrors.mean().item()) < 0.03
    assert bool(((turns >= 0) & (turns <= 2 * math.pi)).all())
    counts = torch.histc(turns[mirrors > 0], 8, 0, 2 * math.pi)
    assert counts.min().item() > 2200
    assert counts.max().item() < 2800


def test_frames_complete_a_direction_to_an_orthonormal_basis() -> None:
    axes = torch.cat([torch.eye(3, dtype=F64), -torch.eye(3, dtype=F64), unit(50)])
    basis = frames(axes).mT
    assert torch.equal(basis[:, 0], axes)
    torch.testing.assert_close(basis @ basis.mT, torch.eye(3, dtype=F64).expand(len(axes), 3, 3), rtol=0, atol=1e-14)


# -- the size after a contraction ---------------------------------------------------------------------------------


def test_contraction_scale_is_the_cube_root_of_the_jacobians_determinant() -> None:
    positions = unit(20) * torch.logspace(-2, 4, 20, dtype=F64)[:, None]
    found = contraction_scale(positions)
    for position, scale in zip(positions, found, strict=True):
        jacobian = torch.autograd.functional.jacobian(contract, position)
        assert scale.item() == pytest.approx(jacobian.det().abs().item() ** (1 / 3), rel=1e-9)


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_contraction_scale_far_away_is_finite_and_falls(dtype: torch.dtype) -> None:
    positions = torch.tensor([[0.0, 0, 0], [0.5, 0, 0], [2, 0, 0], [1e10, 0, 0], [1e15, 1e15, 0], [3e38, 3e38, 0]])
    scale = contraction_scale(positions.to(dtype))
    assert scale[:2].tolist() == [1, 1]
    assert bool(scale.isfinite().all())
    assert bool((scale[1:].diff() < 0).all())


def test_sample_points_carries_the_frustums_of_the_samples() -> None:
    rays = Rays(torch.zeros(2, 3), unit(2, torch.float32), pixel_radii=torch.tensor([0.1, 0.2]))
    samples = Samples.regular(torch.tensor([[0.0, 1.0], [2.0, 3.0]]), torch.tensor([[1.0, 2.0], [3.0, 5.0]]))
    points = sample_points(rays, samples, "frustum")
    assert points.frustums is not None
    assert len(points.frustums) == 4
    assert points.frustums.t_ends.tolist() == [1, 2, 3, 5]
    assert points.frustums.radii.tolist() == pytest.approx([0.1, 0.1, 0.2, 0.2])
    assert torch.equal(points.frustums.directions[2:], rays.directions[1].expand(2, 3))
    torch.testing.assert_close(points.positions, samples.positions(rays))
