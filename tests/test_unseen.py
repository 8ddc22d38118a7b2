"""Views between and around the training cameras: where they stand, and that their patches are images of them."""

import math

import pytest
import torch
from torch import Tensor

from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.unseen import REACH, moved_rays, square_patches, unseen_patches, unseen_poses
from nerfloom.geometry.rays import Rays


def turned(angle: float, position: tuple[float, float, float]) -> Tensor:
    """(3, 4) a camera at `position` that is turned about z."""
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor([[c, -s, 0, position[0]], [s, c, 0, position[1]], [0, 0, 1, position[2]]])


def cameras(poses: Tensor, size: int = 16, focal: float = 20.0) -> Cameras:
    each = torch.ones(len(poses))
    sizes = torch.full((len(poses),), size)
    return Cameras(poses, focal * each, focal * each, size / 2 * each, size / 2 * each, sizes, sizes)


TRIANGLE = torch.stack([turned(0.2, (0, 0, 0)), turned(0.4, (1, 0, 0)), turned(0.6, (0, 1, 0))])
FAR = torch.stack([*TRIANGLE, turned(2.0, (50, 50, 50)), turned(2.1, (51, 50, 50))])


def test_one_camera_has_no_other_view() -> None:
    pose = TRIANGLE[1:2]
    torch.testing.assert_close(unseen_poses(pose, torch.zeros(5, dtype=torch.int64)), pose.expand(5, 3, 4))


def test_two_cameras_have_the_line_between_and_a_little_behind_them() -> None:
    """Positions are even on the line from -1/8 to 9/8 of the way, and rotations follow."""
    torch.manual_seed(0)
    found = unseen_poses(TRIANGLE[:2], torch.zeros(4000, dtype=torch.int64))
    share = found[:, 0, 3]
    assert float(found[:, 1:, 3].abs().max()) < 1e-6
    edge = (REACH - 1) / 2
    even = (torch.arange(4000) + 0.5) / 4000 * REACH - edge
    assert float((share.sort().values - even).abs().max()) < 0.05
    angles = torch.atan2(found[:, 1, 0], found[:, 0, 0])
    torch.testing.assert_close(angles, 0.2 + 0.2 * share, atol=2e-3, rtol=0)  # of the mean of matrices: almost linear


def test_views_stand_evenly_around_a_camera_and_its_neighbours() -> None:
    """The position is uniform over a triangle: its mean is the middle, its covariance that of the triangle."""
    torch.manual_seed(0)
    found = unseen_poses(FAR, torch.randint(3, (20_000,)))
    corners = TRIANGLE[:, :, 3].double()
    positions = found[:, :, 3].double()
    torch.testing.assert_close(positions.mean(0), corners.mean(0), atol=1e-2, rtol=0)
    centred = REACH * (corners - corners.mean(0))
    torch.testing.assert_close(positions.T.cov(), centred.T @ centred / 12, atol=1e-3, rtol=0)
    rotations = found[:, :, :3].double()
    identity = torch.eye(3, dtype=torch.float64).expand(len(found), 3, 3)
    torch.testing.assert_close(rotations.transpose(1, 2) @ rotations, identity, atol=1e-5, rtol=0)
    assert float(torch.linalg.det(rotations).min()) > 0.99


def test_opposite_cameras_still_give_rotations() -> None:
    poses = torch.stack([turned(0.0, (1, 0, 0)), turned(math.pi, (-1, 0, 0))])
    rotations = unseen_poses(poses, torch.zeros(50, dtype=torch.int64))[:, :, :3].double()
    torch.testing.assert_close(torch.linalg.det(rotations), torch.ones(50, dtype=torch.float64), atol=1e-5, rtol=0)


def test_rays_that_move_with_their_cameras_are_those_of_the_moved_cameras() -> None:
    torch.manual_seed(0)
    after = unseen_poses(FAR, torch.arange(5))
    flat = torch.randint(5 * 256, (40,))
    rays, expected = (cameras(poses).pixel_rays(flat, 0.1, 9.0) for poses in (FAR, after))
    chosen = rays.camera_indices
    moved = moved_rays(rays, FAR[chosen], after[chosen])  # type: ignore[index]
    torch.testing.assert_close(moved.origins, expected.origins, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(moved.directions, expected.directions, atol=1e-5, rtol=1e-5)
    assert moved.camera_indices is None


@pytest.mark.parametrize("stride", [1.0, 3.0])
def test_a_patch_is_a_square_of_pixels(stride: float) -> None:
    """Around the middle of an image, where pixels are squares; which way they run does not matter."""
    side, focal = 8, 500.0
    camera = cameras(TRIANGLE[:1], 64, focal)
    middle = camera.rays(torch.tensor([0]), torch.tensor([31.5]), torch.tensor([31.5]), 0.0, 1.0)
    patch = square_patches(middle, side, stride)
    grid = patch.directions.view(side, side, 3).double()
    for apart in (grid.diff(dim=0), grid.diff(dim=1)):
        torch.testing.assert_close(
            apart.norm(dim=-1), torch.full(apart.shape[:2], stride / focal, dtype=torch.float64), atol=0, rtol=1e-2
        )
    square = (grid[1:, :-1] - grid[:-1, :-1]) * (grid[:-1, 1:] - grid[:-1, :-1])
    assert float(square.sum(-1).abs().max()) < 0.02 * (stride / focal) ** 2
    torch.testing.assert_close(patch.directions.mean(0), middle.directions[0], atol=1e-3, rtol=0)
    columns, rows, ahead = camera.project(patch.origins + patch.directions, 0)
    assert bool(ahead.all())
    places = torch.stack([columns, rows], dim=-1)
    assert float(torch.cdist(places, places).max()) == pytest.approx(2**0.5 * (side - 1) * stride, rel=0.02)


def test_patches_have_all_that_rays_have() -> None:
    torch.manual_seed(0)
    rays = cameras(FAR).pixel_rays(torch.randint(5 * 256, (6,)), 0.1, 9.0, times=torch.rand(5))
    patches = unseen_patches(rays, FAR, 8)
    assert len(patches) == 6 * 64
    assert patches.times is not None
    assert torch.equal(patches.times.view(6, 64), rays.times[:, None].expand(6, 64))  # type: ignore[index]
    assert torch.equal(patches.origins.view(6, 64, 3)[:, 0], patches.origins.view(6, 64, 3)[:, 63])
    torch.testing.assert_close(patches.directions.norm(dim=-1), torch.ones(6 * 64))
    assert bool(((patches.nears == 0.1) & (patches.fars == 9)).all())


def test_rays_without_cameras_or_sizes_have_no_unseen_views() -> None:
    rays = Rays(torch.zeros(1, 3), torch.tensor([[0.0, 0.0, -1.0]]))
    with pytest.raises(ValueError, match="rays of training cameras"):
        unseen_patches(rays, FAR, 8)
    with pytest.raises(ValueError, match="radii"):
        square_patches(rays, 8)
