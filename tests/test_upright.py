"""The up direction of photographs that lie on their side."""

from __future__ import annotations

import math
import os
from pathlib import Path

import pytest
import torch
from torch import Tensor

from nerfloom.cameras.poses import place
from nerfloom.cameras.upright import sideways_up
from nerfloom.dataparsers.colmap import Colmap
from nerfloom.dataparsers.record3d import Record3D

Z = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def looking(origins: Tensor, at: Tensor, roll: float) -> Tensor:
    """Return poses (M, 3, 4) of cameras that look at a point (3,) or points (M, 3), rolled by an angle, degrees.

    A roll of 90 puts the world's up direction to the left in the image.
    """
    ahead = torch.nn.functional.normalize(at - origins, dim=-1)
    right = torch.nn.functional.normalize(torch.linalg.cross(ahead, Z.expand_as(ahead)), dim=-1)
    up = torch.linalg.cross(right, ahead)
    c, s = math.cos(math.radians(roll)), math.sin(math.radians(roll))
    return torch.stack([c * right - s * up, s * right + c * up, -ahead, origins], dim=-1)


def circle(height: float, degrees: float = 360, count: int = 24, wobble: float = 0.1) -> Tensor:
    """Return positions (M, 3) on an arc of radius 2 around the z axis, at about a height."""
    angle = torch.linspace(0, math.radians(degrees), count, dtype=torch.float64)
    heights = height + wobble * torch.sin(5 * angle)
    return torch.stack([2 * angle.cos(), 2 * angle.sin(), heights], dim=-1)


def degrees_apart(a: Tensor, b: Tensor) -> float:
    return math.degrees(math.acos(min(float(a @ b / (a.norm() * b.norm())), 1.0)))


@pytest.mark.parametrize("roll", [90, -90])
@pytest.mark.parametrize(("height", "around"), [(0.5, 120), (1.5, 120), (0.5, 200), (1.5, 200), (1.5, 360), (3.0, 360)])
def test_what_is_up_is_found_where_photographs_lie_on_their_side(roll: float, height: float, around: float) -> None:
    poses = looking(circle(height, around), torch.zeros(3, dtype=torch.float64), roll)
    up = sideways_up(poses)
    assert up is not None
    assert degrees_apart(up, Z) < 3
    assert degrees_apart(place(poses, "auto").transform[:, :3].double() @ Z, Z) < 3


def test_it_is_found_by_the_frame_of_the_poses() -> None:
    rotation = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(3)))[0]
    rotation = rotation * torch.linalg.det(rotation)
    poses = looking(circle(1.0), torch.zeros(3, dtype=torch.float64), 90)
    up = sideways_up(rotation @ poses)
    assert up is not None
    assert degrees_apart(up, rotation @ Z) < 3


def test_level_cameras_have_up_on_the_left() -> None:
    poses = looking(circle(0.0, wobble=0.05), torch.zeros(3, dtype=torch.float64), 90)
    up = sideways_up(poses)
    assert up is not None
    assert degrees_apart(up, Z) < 3


@pytest.mark.parametrize("height", [0.0, 0.5, 1.5, 3.0])
@pytest.mark.parametrize("around", [30, 90, 180, 360])
def test_upright_photographs_are_left_as_they_are(height: float, around: float) -> None:
    poses = looking(circle(height, around), torch.zeros(3, dtype=torch.float64), 0)
    assert sideways_up(poses) is None
    assert torch.equal(place(poses, "auto").transform, place(poses, "up").transform)


def test_a_tilted_hand_is_not_a_side() -> None:
    tilts = 15 * torch.sin(torch.arange(24) * 2.4)
    poses = torch.cat(
        [looking(circle(1.0)[i : i + 1], torch.zeros(3, dtype=torch.float64), float(tilts[i])) for i in range(24)]
    )
    assert sideways_up(poses) is None


def test_to_look_up_and_down_in_a_line_says_nothing() -> None:
    """The same turns of the cameras as around something on their side, but they stand above one another."""
    pitch = torch.linspace(-1, 1, 20, dtype=torch.float64)
    origins = torch.stack([torch.zeros(20), torch.zeros(20), -pitch], dim=-1).double()
    ahead = torch.stack([torch.cos(pitch), torch.zeros(20), torch.sin(pitch)], dim=-1)
    assert sideways_up(looking(origins, origins + ahead, 0)) is None


def test_a_flight_that_looks_straight_down_says_nothing() -> None:
    headings = torch.linspace(0, 2 * math.pi, 30, dtype=torch.float64)
    right = torch.stack([headings.cos(), headings.sin(), torch.zeros(30)], dim=-1).double()
    back = Z.expand(30, 3)
    origins = torch.stack([3 * headings.cos(), 3 * headings.sin(), torch.full((30,), 5.0)], dim=-1)
    poses = torch.stack([right, torch.linalg.cross(back, right), back, origins], dim=-1)
    assert sideways_up(poses) is None


def test_what_faces_forward_says_nothing() -> None:
    generator = torch.Generator().manual_seed(0)
    origins = torch.randn(20, 3, dtype=torch.float64, generator=generator) * torch.tensor([1.0, 0.05, 0.6])
    for roll in (0, 90):
        poses = looking(origins, origins + torch.tensor([0.0, 5.0, 0.0]), roll)
        assert sideways_up(poses) is None


def test_few_or_broken_poses_say_nothing() -> None:
    poses = looking(circle(1.0), torch.zeros(3, dtype=torch.float64), 90)
    assert sideways_up(poses[:2]) is None
    poses[3, 1, 1] = math.nan
    assert sideways_up(poses) is None


DATA = os.environ.get("NERFLOOM_DATA")
needs_data = pytest.mark.skipif(DATA is None, reason="NERFLOOM_DATA is not set")


@needs_data
def test_a_real_capture_on_its_side_stands_on_its_table() -> None:
    """The cup lies in the photographs. Most of the points are on the desk, in one plane; its normal is up."""
    assert DATA is not None
    path = Path(DATA) / "colmap_cup"
    turned, as_is = (Colmap(orientation_method=way).parse(path, "train") for way in ("auto", "up"))  # type: ignore[arg-type]
    tilts = []
    for scene in (turned, as_is):
        assert scene.points is not None
        tilts.append(degrees_apart(_plane_of_most(scene.points.double()), Z))
    tilts = [min(tilt, 180 - tilt) for tilt in tilts]
    print(f"the desk is tilted by {tilts[0]:.1f} degrees, and by {tilts[1]:.1f} if the mean up direction counts")
    assert tilts[0] < 12 < 45 < tilts[1]
    ahead = -turned.cameras.camera_to_worlds[:, :, 2].mean(0)
    assert float(ahead[2]) < 0  # from above


def _plane_of_most(points: Tensor) -> Tensor:
    """Return the normal of the plane through three of the points that has most others near it."""
    generator = torch.Generator().manual_seed(0)
    points = points[points.norm(dim=-1) < 2]
    best, most = Z, 0
    for _ in range(500):
        a, b, c = points[torch.randperm(len(points), generator=generator)[:3]]
        normal = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)
        near = int((((points - a) @ normal).abs() < 0.01).sum())
        if near > most:
            best, most = normal, near
    return best


@needs_data
def test_a_device_that_knows_gravity_is_believed() -> None:
    assert DATA is not None
    path = Path(DATA) / "record3d_door"
    poses = [
        Record3D(orientation_method=way).parse(path, "train").cameras.camera_to_worlds  # type: ignore[arg-type]
        for way in ("auto", "up")
    ]
    assert torch.equal(*poses)
