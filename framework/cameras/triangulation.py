"""Covariance of triangulation: how well cameras locate a point, and the error of a length between two points.

A camera that sees a point at a pixel with an error of sigma pixels knows the point up to J dx = sigma, where J is the
derivative of its projection. N cameras with independent errors know it with the covariance

    C = (sum over cameras of J^T J / sigma^2)^-1,

the inverse of the Fisher information, which least squares of reprojection errors reach to first order (Hartley and
Zisserman 2004, section 5.2). Along the viewing direction, the error is sigma * depth^2 / (focal length * baseline), up
to a factor that depends on the arrangement.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from nerfloom.cameras.cameras import Cameras

STEP = 1e-5
"""Step of the numerical derivative of a projection, as a fraction of the point's distance."""
SINGULAR = 1e-12
"""Points are not located where the smallest eigenvalue of the information is below this fraction of the largest."""


def projection_jacobians(cameras: Cameras, point: Tensor) -> Tensor:
    """Return the derivative (M, 2, 3) float64 of a point's column and row in the images, pixels per unit of length.

    It is a central difference in float64, so that it holds for every lens.

    Args:
        cameras: M cameras on the CPU.
        point: (3,) position in front of all cameras.
    """
    precise, count = cameras.in_float64(), len(cameras)
    step = STEP * (precise.camera_to_worlds[:, :, 3] - point.double()).norm(dim=-1).clamp(min=STEP)
    columns = []
    for axis in torch.eye(3, dtype=torch.float64):
        there, back = (
            torch.stack(precise.project(point.double() + sign * step[:, None] * axis, torch.arange(count))[:2], dim=-1)
            for sign in (1, -1)
        )
        columns.append((there - back) / (2 * step)[:, None])
    return torch.stack(columns, dim=-1)


def point_covariance(jacobians: Tensor, pixel_error: float) -> Tensor:
    """Return the covariance (3, 3) float64 of a point that N cameras see; infinite if they do not locate it.

    They do not if there are fewer than two, or if all look along one line.

    Args:
        jacobians: (N, 2, 3) derivatives of the point's projections, from `projection_jacobians`.
        pixel_error: standard deviation of columns and rows, pixels.
    """
    information = torch.einsum("nij,nik->jk", jacobians.double(), jacobians.double()) / pixel_error**2
    values, vectors = torch.linalg.eigh(information)
    if not bool(values[0] > SINGULAR * values[2]):
        return torch.full((3, 3), math.inf, dtype=torch.float64)
    return vectors @ torch.diag(1 / values) @ vectors.T


def reading_error(jacobians: Tensor, pixel_error: float) -> float:
    """Return the length of `pixel_error` in the sharpest image at a point, by `jacobians` (N, 2, 3); inf for N = 0."""
    if not len(jacobians):
        return math.inf
    return pixel_error / float(jacobians.double().square().sum((1, 2)).div(2).sqrt().max())


def length_error(start: Tensor, end: Tensor, covariances: tuple[Tensor, Tensor]) -> float:
    """Return the standard deviation of the distance between two points with independent errors.

    With the unit vector u between them, it is sqrt(u^T (C_start + C_end) u), to first order.

    Args:
        start, end: (3,) the points, which differ.
        covariances: covariances (3, 3) of both.
    """
    total = covariances[0] + covariances[1]
    if not bool(total.isfinite().all()):
        return math.inf
    along = torch.nn.functional.normalize(end.double() - start.double(), dim=0)
    return math.sqrt(float(along @ total @ along))
