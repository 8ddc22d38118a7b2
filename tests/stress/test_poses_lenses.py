"""Rotations by nothing and by half a turn; lenses that fold the picture over."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from nerfloom.cameras.poses import rotation_between
from nerfloom.cameras.refinement import PoseRefinement
from nerfloom.geometry.lenses import LENSES
from nerfloom.geometry.rays import Rays
from nerfloom.kernels.math import cross_matrix
from tests.stress.backends import backends
from tests.test_lenses import HEIGHT, WIDTH, cameras

# -- rotations ----------------------------------------------------------------------------------------------------

AXIS = torch.tensor([2.0, -1.0, 2.0], dtype=torch.float64) / 3


def rodrigues(angle: float) -> Tensor:
    """(3, 3) the rotation about `AXIS`, without 0 / 0."""
    k = cross_matrix(AXIS)
    return torch.eye(3, dtype=torch.float64) + math.sin(angle) * k + 2 * math.sin(angle / 2) ** 2 * k @ k


def motions(tangents: Tensor, group: str) -> Tensor:
    """Motions of pose refinement for any numbers (M, 6), as a function of them."""
    refinement = PoseRefinement(len(tangents), group)  # type: ignore[arg-type]
    del refinement.tangents
    refinement.tangents = tangents
    return refinement.motions()


@pytest.mark.entry(18)
@pytest.mark.parametrize("group", ["SO3xR3", "SE3"])
@pytest.mark.parametrize("angle", [0.0, 1e-30, 1e-12, 1e-8, 1e-4, 1.0, math.pi, 6.0])
def test_rotations_by_any_angle(angle: float, group: str) -> None:
    """The truth is Rodrigues' formula in float64, with limits for 0 / 0, and finite differences for gradients."""
    tangents = torch.cat([torch.zeros(3, dtype=torch.float64), AXIS * angle])[None]
    exact, rounded = (motions(t, group)[0, :, :3] for t in (tangents, tangents.float()))
    torch.testing.assert_close(exact, rodrigues(angle), rtol=0, atol=1e-12)
    torch.testing.assert_close(rounded.double(), rodrigues(angle), rtol=0, atol=1e-5)
    assert torch.autograd.gradcheck(lambda t: motions(t, group), tangents.requires_grad_())


@pytest.mark.entry(18)
@pytest.mark.parametrize("group", ["SO3xR3", "SE3"])
def test_the_gradient_of_no_rotation_in_closed_form(group: str) -> None:
    """c . (w x v) has the gradient v x c in w."""
    v, c = torch.tensor([[0.3, -0.5, 0.8]]), torch.tensor([[1.0, 2.0, -1.5]])
    refinement = PoseRefinement(1, group)  # type: ignore[arg-type]
    rays = Rays(torch.zeros(1, 3), v, torch.zeros(1), torch.ones(1), camera_indices=torch.tensor([0]))
    (refinement(rays).directions * c).sum().backward()
    assert refinement.tangents.grad is not None
    torch.testing.assert_close(refinement.tangents.grad[:, 3:], torch.linalg.cross(v, c), rtol=1e-5, atol=1e-6)
    assert refinement.tangents.grad[:, :3].abs().max().item() < 1e-7


@pytest.mark.entry(18)
@pytest.mark.parametrize("short_of", [None, 1e-12, 1e-6, 1e-5, 1e-4, 1e-3, 1.0, 0.0])
def test_the_smallest_rotation_between_directions(short_of: float | None) -> None:
    """It goes from one direction to the same, to almost the opposite (`short_of` half a turn), or to the opposite."""
    angle = 0.0 if short_of is None else math.pi - short_of
    start = torch.tensor([1.0, 2.0, -2.0], dtype=torch.float64) / 3
    across = torch.tensor([2.0, 1.0, 2.0], dtype=torch.float64) / 3
    end = math.cos(angle) * start + math.sin(angle) * across
    found = rotation_between(5 * start, 0.1 * end)
    torch.testing.assert_close(found @ start, end, rtol=0, atol=1e-4)
    torch.testing.assert_close(found @ found.T, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-6)
    assert torch.linalg.det(found).item() == pytest.approx(1, abs=1e-6)


# -- lenses -------------------------------------------------------------------------------------------------------


@pytest.mark.entry(24)
@backends()
@pytest.mark.parametrize(("model", "k1"), [("opencv", -0.5), ("opencv", -0.2), ("opencv", 0.4), ("fisheye", -0.3)])
def test_undistortion_finds_the_root_next_to_the_axis(backend: str, model: str, k1: float) -> None:
    """Against bisection. r + k1 r^3 turns round: beyond its largest value there is no root, and a ray at its edge."""
    camera = cameras(model, [k1] + [0.0] * (len(LENSES[model]) - 1), count=1)
    middle = torch.tensor([WIDTH / 2 + 0.5]), torch.tensor([HEIGHT / 2 + 0.5])  # in the middle of a pixel
    camera = replace(camera, camera_to_worlds=torch.eye(4)[None, :3], cx=middle[0], cy=middle[1])
    flat = torch.arange(WIDTH * HEIGHT)
    directions = camera.pixel_rays(flat, 0.0, 1.0).directions.double()
    x = (flat % WIDTH + 0.5 - middle[0]).double() / camera.fx
    y = (flat // WIDTH + 0.5 - middle[1]).double() / camera.fy
    distance = torch.hypot(x, y)
    assert distance.min() == 0
    reach = (-1 / (3 * k1)) ** 0.5 if k1 < 0 else 3.0
    low, high = torch.zeros_like(distance), torch.full_like(distance, reach)
    for _ in range(60):
        half = (low + high) / 2
        nearer = half + k1 * half**3 < distance
        low, high = torch.where(nearer, half, low), torch.where(nearer, high, half)
    off_axis = directions[:, :2].norm(dim=-1)
    found = off_axis / -directions[:, 2] if model == "opencv" else torch.atan2(off_axis, -directions[:, 2])
    edge = reach + k1 * reach**3
    inside = distance < edge - 1e-3
    assert bool(inside.any())
    assert bool(inside.all()) == (k1 > 0)
    torch.testing.assert_close(found[inside], low[inside], rtol=1e-4, atol=1e-5)
    assert bool((found <= reach + 1e-4).all())
    assert bool(directions.isfinite().all())
    across = torch.stack([x, -y], dim=-1) / distance.clamp(min=1e-9)[:, None] * off_axis[:, None]
    torch.testing.assert_close(directions[:, :2], across, rtol=0, atol=1e-5)
