"""Pixels of orthographic cameras: cylinders, which are as wide at all distances."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from nerfloom.geometry.multisamples import fixed_pattern, hashed_pattern, multisamples
from nerfloom.geometry.points import Footprint, Frustums, sample_points
from nerfloom.geometry.rays import Rays, Samples
from nerfloom.kernels.grids.multisamples import frustum_balls, unit_multisamples, unit_multisamples_reference
from nerfloom.kernels.octree.walk import smallest_cells
from tests.test_lenses import cameras

F64 = torch.float64
RADIUS = 2 / 12**0.5 / 12
"""Of pixels of cameras with 12 pixels a unit."""
STARTS, ENDS = (torch.tensor([each, each], dtype=F64) for each in ([1.0, 100.0], [1.5, 104.0]))
MIDDLES, LENGTHS = ((ENDS + STARTS) / 2).flatten(), (ENDS - STARTS).flatten()
SAMPLES = Samples.regular(STARTS, ENDS)
BOX = torch.tensor([[-1.0] * 3, [1.0] * 3])


def parallel_rays() -> Rays:
    return cameras("orthographic", dtype=F64).pixel_rays(torch.arange(2), 0.1, 200.0)


def cylinders() -> Frustums:
    found = sample_points(parallel_rays(), SAMPLES, "frustum").frustums
    assert found is not None
    return found


def in_float32(cones: Frustums) -> Frustums:
    changed: dict[str, Any] = {name: x.float() for name, x in vars(cones).items() if isinstance(x, Tensor)}
    return replace(cones, **changed)


@pytest.mark.parametrize("footprint", ["radius", "gaussian", "frustum"])
def test_points_are_as_wide_far_as_near(footprint: Footprint) -> None:
    rays = parallel_rays()
    for some in (rays, rays[torch.arange(2)], rays.to("cpu"), rays.detached()):
        radii = sample_points(some, SAMPLES, footprint).radii
        torch.testing.assert_close(radii, torch.full((4,), RADIUS, dtype=F64))


def test_the_gaussian_of_a_cylinder() -> None:
    """A disk of radius r has the variance r^2 / 4 along each axis, an interval of length l l^2 / 12."""
    rays = parallel_rays()
    points = sample_points(rays, SAMPLES, "gaussian")
    torch.testing.assert_close(points.positions, rays.points(SAMPLES.ray_indices, MIDDLES))
    truth = torch.stack([LENGTHS.square() / 12, torch.full((4,), RADIUS**2 / 4, dtype=F64)], -1)
    torch.testing.assert_close(points.variances, truth)


def test_the_points_of_a_cylinder_have_its_mean_and_variances() -> None:
    cones = cylinders()
    for pattern in (fixed_pattern(cones), hashed_pattern(cones)):
        positions, deviations = multisamples(cones, pattern)
        mean = positions.mean(1)
        torch.testing.assert_close(mean, cones.origins + MIDDLES[:, None] * cones.directions)
        apart = positions - mean[:, None]
        along = (apart * cones.directions[:, None]).sum(-1)
        torch.testing.assert_close(along.square().mean(1), LENGTHS.square() / 12)
        beside = apart.square().sum(-1) - along.square()
        torch.testing.assert_close(beside.mean(1), torch.full((4,), RADIUS**2 / 2, dtype=F64))
        torch.testing.assert_close(deviations, torch.full((4, 6), RADIUS / 8**0.5, dtype=F64))


def test_grids_see_cylinders() -> None:
    """Whatever computes it: the compiled form, which has cones alone, is not taken."""
    exact, cones = cylinders(), in_float32(cylinders())
    pattern = fixed_pattern(exact)
    truth = unit_multisamples_reference(exact, pattern, BOX.double(), False)
    found = unit_multisamples(cones, fixed_pattern(cones), BOX, False).double()
    torch.testing.assert_close(found, truth, rtol=1e-5, atol=1e-5)
    deviations = (LENGTHS.square() / 12 * (RADIUS**2 / 4) ** 2) ** (1 / 6) / 2  # half as large in the cube
    torch.testing.assert_close(frustum_balls(cones, BOX, False)[:, 3].double(), deviations, rtol=1e-5, atol=0)


def test_boxes_alone_choose_the_levels_of_an_octree() -> None:
    assert smallest_cells(parallel_rays()) is None
    assert smallest_cells(cameras("pinhole").pixel_rays(torch.arange(2), 0.1, 9.0)) is not None
