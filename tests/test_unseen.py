"""Views between and around the training cameras: where they stand, and which way they look."""

import math

import torch
from torch import Tensor

from nerfloom.cameras.unseen import REACH, unseen_poses


def turned(angle: float, position: tuple[float, float, float]) -> Tensor:
    """(3, 4) a camera at `position` that is turned about z."""
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor([[c, -s, 0, position[0]], [s, c, 0, position[1]], [0, 0, 1, position[2]]])


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
    """The position is uniform over a triangle: its mean is the middle, its covariance the triangle's."""
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


def test_a_neighbour_that_looks_elsewhere_does_not_count() -> None:
    """Two cameras 70 degrees apart in direction, which rise as they turn, and one 50 degrees from the first."""
    poses = []
    for angle, place in ((0, (0.0, 0, 0)), (70, (1.0, 0, 0)), (50, (0, 1.0, 0))):
        c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
        poses.append(torch.tensor([[1.0, 0, 0, place[0]], [0, c, -s, place[1]], [0, s, c, place[2]]]))
    found = unseen_poses(torch.stack(poses), torch.zeros(200, dtype=torch.int64))
    assert not bool(found[:, 0, 3].any())
    assert float(found[:, 1, 3].max()) > 0.5
    tilts = torch.rad2deg(torch.atan2(found[:, 2, 1], found[:, 1, 1]))
    assert -7 < float(tilts.min()) < float(tilts.max()) < 57  # an eighth of the way beyond each
