"""The covariance of triangulated points, against Monte Carlo, and the error of a length."""

import math

import pytest
import torch
from torch import Tensor

from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.triangulation import length_error, point_covariance, projection_jacobians, reading_error
from nerfloom.evaluation.paths import look_at

SIGMA = 0.5
TRIALS = 20_000


def cameras_around(positions: list[list[float]], target: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Cameras:
    """Pinhole cameras that look at a point."""
    up = torch.tensor([0.0, 0.0, 1.0])
    poses = torch.stack([look_at(torch.tensor(each), torch.tensor(target), up) for each in positions])
    count = len(positions)
    focal, center = torch.full((count,), 500.0), torch.full((count,), 200.0)
    size = torch.full((count,), 400)
    return Cameras(poses, focal, focal * 1.1, center, center, size, size)


ARC = [[4 * math.sin(a), -4 * math.cos(a), 0.5] for a in (-0.3, -0.1, 0.05, 0.25)]


def triangulated(cameras: Cameras, places: Tensor, start: Tensor) -> Tensor:
    """Points (T, 3) of least reprojection error for pixels (T, M, 2), by Gauss-Newton steps with exact derivatives."""
    poses = cameras.camera_to_worlds.double()
    focal = torch.stack([cameras.fx, cameras.fy], -1).double()
    center = torch.stack([cameras.cx, cameras.cy], -1).double()
    points = start.expand(len(places), 3).clone()
    flip = torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
    for _ in range(6):
        local = torch.einsum("mji,tmj->tmi", poses[:, :, :3], points[:, None] - poses[:, :, 3]) * flip
        x, z = local[..., :2], local[..., 2:]
        residual = places - (focal * x / z + center - 0.5)
        to_local = (poses[:, :, :3] * flip).transpose(1, 2)
        by_local = torch.cat([torch.diag_embed(focal / z), (-focal * x / z**2)[..., None]], -1)
        jacobian = (by_local @ to_local).flatten(1, 2)
        points = points + torch.linalg.lstsq(jacobian, residual.flatten(1)[..., None]).solution[..., 0]
    return points


def noisy(cameras: Cameras, point: Tensor, seed: int) -> Tensor:
    """Estimates (TRIALS, 3) of a point from pixels with errors."""
    exact = torch.stack(cameras.in_float64().project(point.expand(len(cameras), 3), torch.arange(len(cameras)))[:2], -1)
    noise = torch.randn(TRIALS, len(cameras), 2, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return triangulated(cameras, exact + SIGMA * noise, point)


@pytest.mark.parametrize("point", [(0.1, 0.2, -0.1), (0.9, 0.5, 0.7)])
def test_the_covariance_is_that_of_least_squares(point: tuple[float, float, float]) -> None:
    cameras, exact = cameras_around(ARC), torch.tensor(point, dtype=torch.float64)
    found = noisy(cameras, exact, 0)
    simulated = torch.cov(found.T)
    covariance = point_covariance(projection_jacobians(cameras, exact), SIGMA)
    # The ratio of both along any direction is an eigenvalue of this.
    root = torch.linalg.cholesky(covariance)
    ratios = torch.linalg.eigvalsh(torch.linalg.solve(root, torch.linalg.solve(root, simulated).T))
    print(f"variances: simulation / formula {ratios.tolist()}")
    assert float((ratios - 1).abs().max()) < 0.04


def test_the_error_of_a_length_is_that_of_simulated_lengths() -> None:
    cameras = cameras_around(ARC)
    ends = [torch.tensor(each, dtype=torch.float64) for each in ((0.1, 0.2, -0.1), (0.9, 0.5, 0.7))]
    lengths = (noisy(cameras, ends[1], 2) - noisy(cameras, ends[0], 1)).norm(dim=-1)
    covariances = [point_covariance(projection_jacobians(cameras, each), SIGMA) for each in ends]
    error = length_error(*ends, (covariances[0], covariances[1]))
    print(f"length: {float(lengths.mean()):.4f}, simulated {float(lengths.std()):.5f}, formula {error:.5f}")
    assert error == pytest.approx(float(lengths.std()), rel=0.03)


def test_the_depth_of_two_cameras_side_by_side() -> None:
    """sigma * sqrt(2) * depth^2 / (focal length * baseline), the closed form of stereo with parallel axes."""
    depth, baseline = 5.0, 0.4
    cameras = cameras_around([[0.0, -depth, 0.0], [baseline, -depth, 0.0]], (0.0, 1e6, 0.0))
    point = torch.tensor([baseline / 2, 0.0, 0.0], dtype=torch.float64)
    covariance = point_covariance(projection_jacobians(cameras, point), SIGMA)
    assert float(covariance[1, 1]) ** 0.5 == pytest.approx(SIGMA * 2**0.5 * depth**2 / (500 * baseline), rel=1e-3)


def test_more_cameras_and_longer_baselines_help() -> None:
    point = torch.zeros(3, dtype=torch.float64)
    traces = []
    for positions in (ARC[1:3], [ARC[0], ARC[3]], ARC):
        jacobians = projection_jacobians(cameras_around(positions), point)
        traces.append(float(point_covariance(jacobians, SIGMA).trace()))
    assert traces[0] > traces[1] > traces[2]


def test_one_direction_locates_nothing() -> None:
    point = torch.zeros(3, dtype=torch.float64)
    for positions in (ARC[:1], [[0.0, -4.0, 0.0], [0.0, -2.0, 0.0]], []):
        cameras = cameras_around([*positions, ARC[0]])[: len(positions)]
        jacobians = projection_jacobians(cameras, point)
        covariance = point_covariance(jacobians, SIGMA)
        assert bool(covariance.isinf().all())
        assert length_error(point, point + 1, (covariance, covariance)) == math.inf


def test_reading_is_half_a_pixel_of_the_sharpest_image() -> None:
    cameras = cameras_around([[0.0, -8.0, 0.0], [0.0, -2.0, 0.0]])
    jacobians = projection_jacobians(cameras, torch.zeros(3, dtype=torch.float64))
    assert reading_error(jacobians, SIGMA) == pytest.approx(SIGMA * 2.0 / (500 * ((1 + 1.1**2) / 2) ** 0.5), rel=1e-4)


def test_the_derivative_is_that_of_a_distorted_lens() -> None:
    cameras = cameras_around(ARC)
    lens = torch.tensor([[-0.2, 0.05, 0.001, -0.002]]).expand(len(ARC), 4)
    fisheye = Cameras(*(getattr(cameras, name) for name in ("camera_to_worlds", "fx", "fy", "cx", "cy")),
                      cameras.widths, cameras.heights, "fisheye", lens)  # fmt: skip
    point = torch.tensor([0.5, 0.3, 0.4], dtype=torch.float64, requires_grad=True)
    columns, rows, _ = fisheye.in_float64().project(point.expand(len(ARC), 3), torch.arange(len(ARC)))
    exact = torch.stack([torch.stack([torch.autograd.grad(each, point, retain_graph=True)[0] for each in values])
                         for values in (columns, rows)], 1)  # fmt: skip
    torch.testing.assert_close(projection_jacobians(fisheye, point.detach()), exact, rtol=1e-6, atol=1e-6)
