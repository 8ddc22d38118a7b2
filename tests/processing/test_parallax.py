"""Cameras that turned on the spot, told from cameras that moved."""

import math

import numpy as np
import pytest
import torch

from nerfloom.dataparsers.camera_spread import camera_spread
from nerfloom.processing.parallax import share_that_turned


def matches(shift: float, focal: float, count: int = 6) -> list[tuple[np.ndarray, np.ndarray]]:
    """Positions of points in views of cameras that turn by 6 degrees a view, and move by `shift` to the side."""
    random = np.random.default_rng(0)
    points = np.stack([*random.uniform(-4, 4, (2, 400)), random.uniform(3, 9, 400)], axis=-1)
    views = []
    for index in range(count):
        angle = math.radians(6 * index)
        turn = np.array([[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]])
        seen = (points - [shift * index, 0, 0]) @ turn.T
        views.append(focal * seen[:, :2] / seen[:, 2:])
    shown = [np.abs(view).max(1) < 0.6 for view in views]
    pairs = [(i, j) for i in range(count) for j in range(i + 1, count)]
    return [(views[i][shown[i] & shown[j]], views[j][shown[i] & shown[j]]) for i, j in pairs]


@pytest.mark.parametrize("focal", [0.7, 1.2, 2.0])
def test_a_rotation_explains_a_panorama_and_no_walk(focal: float) -> None:
    assert share_that_turned(matches(0.0, focal)) == 1
    assert share_that_turned(matches(0.3, focal)) < 0.2


def test_nothing_is_said_of_cameras_that_hardly_moved() -> None:
    still = np.random.default_rng(0).random((50, 2))
    assert share_that_turned([(still, still + 0.001)]) == 0
    assert share_that_turned([]) == 0


def test_the_spread_of_cameras_is_a_share_of_the_distance() -> None:
    poses = torch.eye(4).repeat(4, 1, 1)
    poses[:, :3, 3] = torch.tensor([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    points = torch.tensor([[0.0, 0, 50], [0, 0, -50], [50, 0, 0]])
    assert camera_spread(poses, points) == pytest.approx(1 / 50)
    assert camera_spread(poses, None) is None
    assert camera_spread(poses[:1], points) is None
    poses[:, :3, 3] = torch.tensor([1e5, 2e5, 3.0])
    poses[0, 0, 3] += 1e-2 * 2**-7
    assert camera_spread(poses, None) == 0
