"""The similarity between two sets of poses, against ones that are known."""

import math

import pytest
import torch

from benchmarks.pose_errors import pose_errors
from nerfloom.base.errors import DataError
from nerfloom.geometry.alignment import align, align_cameras


def some_poses(count: int) -> torch.Tensor:
    draws = torch.Generator().manual_seed(0)
    q, _ = torch.linalg.qr(torch.randn(count, 3, 3, generator=draws, dtype=torch.float64))
    q = q * torch.linalg.det(q)[:, None, None]
    return torch.cat([q, torch.randn(count, 3, 1, generator=draws, dtype=torch.float64)], dim=-1)


def moved(poses: torch.Tensor) -> tuple[torch.Tensor, float, torch.Tensor, torch.Tensor]:
    turn, shift, scale = some_poses(1)[0, :, :3], torch.tensor([1.0, -2.0, 3.0], dtype=torch.float64), 2.5
    return (
        torch.cat([turn @ poses[:, :, :3], (scale * turn @ poses[:, :, 3:]) + shift[:, None]], -1),
        scale,
        turn,
        shift,
    )


def test_a_similarity_is_found() -> None:
    poses = some_poses(12)
    target, scale, turn, shift = moved(poses)
    found = align(poses[:, :, 3], target[:, :, 3])
    assert math.isclose(found[0], scale)
    torch.testing.assert_close(found[1], turn)
    torch.testing.assert_close(found[2], shift)
    errors = pose_errors(poses, target)
    assert errors.median_angle < 1e-5
    assert errors.median_distance < 1e-9


def test_cameras_on_a_line_or_in_one_place_are_aligned() -> None:
    poses = some_poses(12)
    poses[:, 1:, 3] = 0
    for squeezed in (poses, torch.cat([poses[:, :, :3], torch.ones_like(poses[:, :, 3:])], dim=-1)):
        target, scale, turn, _ = moved(squeezed)
        found = align_cameras(squeezed, target)
        assert math.isclose(found[0], scale if squeezed is poses else 1.0)
        torch.testing.assert_close(found[1], turn)
        torch.testing.assert_close(found[0] * squeezed[:, :, 3] @ found[1].T + found[2], target[:, :, 3])


def test_mirrored_points_are_not_mirrored_back() -> None:
    points = some_poses(12)[:, :, 3]
    _, rotation, _ = align(points, points * torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64))
    assert math.isclose(float(torch.linalg.det(rotation)), 1.0, rel_tol=1e-9)


def test_errors_are_degrees_and_shares_of_the_extent() -> None:
    poses = some_poses(40)
    target, *_ = moved(poses)
    angle = math.radians(3)
    turn = torch.tensor([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]])
    target[:, :, :3] = target[:, :, :3] @ turn.double()
    errors = pose_errors(poses, target)
    torch.testing.assert_close(errors.angles, torch.full((40,), 3.0, dtype=torch.float64))
    assert errors.median_distance < 1e-9


@pytest.mark.parametrize("points", [torch.zeros(2, 3), torch.arange(12.0).view(4, 3)])
def test_what_leaves_the_rotation_open_is_refused(points: torch.Tensor) -> None:
    with pytest.raises(DataError, match="alignment needs"):
        align(points, points)
