"""Requests: cameras of browsers, parts of pictures, and invalid values."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from nerfloom.viewer.canvas import enlarged, paste
from nerfloom.viewer.keyframes import path_file
from nerfloom.viewer.pace import Piece
from nerfloom.viewer.request import (
    Request,
    color_of,
    corner_of,
    number_in,
    one_of,
    pose_of,
    quaternion_of,
    size_of,
    smaller,
)

NONSENSE: Any = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8) | st.binary(max_size=8),
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=8,
)


def rotation(w: float, x: float, y: float, z: float) -> np.ndarray:
    """Rodrigues' formula, from the axis and the angle of a unit quaternion."""
    angle, axis = 2 * math.atan2(math.hypot(x, y, z), w), np.array([x, y, z]) / max(math.hypot(x, y, z), 1e-12)
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


def test_poses_and_quaternions() -> None:
    generator = np.random.default_rng(0)
    cases = [*generator.normal(size=(20, 4)), [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    for given_one in cases:
        unit = np.asarray(given_one) / np.linalg.norm(given_one)
        pose = pose_of(given_one, (1, 2, 3), 0.9)
        assert pose is not None
        expected = rotation(*unit) @ np.diag([1, -1, -1])  # from y down, z forward to y up, looking along -z
        np.testing.assert_allclose(pose.tensor()[:, :3], expected, atol=1e-6)
        np.testing.assert_allclose(pose.tensor()[:, 3], [1, 2, 3])
        back = np.array(quaternion_of(pose.tensor()))
        assert abs(abs(back @ unit) - 1) < 1e-6


@pytest.mark.parametrize("stride", [1, 2, 3, 7])
def test_rows_of_a_smaller_picture_are_rows_of_it(stride: int) -> None:
    pose = pose_of((0.9, 0.1, -0.2, 0.3), (1, 2, 3), 0.8)
    assert pose is not None
    request = Request(pose, 50, 31)
    whole = request.camera(stride)
    width, height = smaller(50, 31, stride)
    rays = whole.pixel_rays(whole.image_pixels(0), 0.1, 9.0)
    part = request.camera(stride, (2, 4))
    some = part.pixel_rays(part.image_pixels(0), 0.1, 9.0)
    torch.testing.assert_close(some.directions, rays.directions.view(height, width, 3)[2:4].reshape(-1, 3))
    corners = rays.directions.view(height, width, 3).double() @ pose.tensor()[:, :3]
    # The picture spans the same angles for every stride: half a pixel less than the field of view at its edges.
    edge = corners[0, width // 2]
    expected = math.tan(0.4) * (1 - 1 / height)
    assert float(edge[1] / -edge[2]) == pytest.approx(expected, rel=1e-4)


@pytest.mark.medium
@given(NONSENSE, NONSENSE, NONSENSE)
def test_nonsense_makes_no_camera_and_no_error(first: Any, second: Any, third: Any) -> None:
    pose = pose_of(first, second, third)
    if pose is not None:
        matrix = pose.tensor()[:, :3]
        torch.testing.assert_close(matrix @ matrix.T, torch.eye(3, dtype=torch.float64), atol=1e-6, rtol=0)
    width, height = size_of(first, second, 512)
    assert 8 <= min(width, height) <= max(width, height) <= 512
    assert 0 <= number_in(first, 0, 1, 0.5) <= 1
    assert one_of(first, ("a", "b")) in ("a", "b")
    assert all(0 <= part <= 1 for part in color_of(first))
    assert all(math.isfinite(part) for part in corner_of(first, (0, 0, 0)))


@given(NONSENSE)
def test_no_name_leaves_the_folder(name: Any) -> None:
    file = path_file(Path("/runs/one"), name)
    assert file.parent == Path("/runs/one")
    assert file.name.startswith("camera_path")
    assert file.suffix == ".json"
    assert len(file.name) < 80


@pytest.mark.parametrize("name", ["../../etc/passwd", "/etc/passwd", "a\0b", "eval", "..", "\u202e", "config.yml"])
def test_names_that_point_elsewhere(name: str) -> None:
    assert path_file(Path("run"), name).parent == Path("run")
    assert path_file(Path("run"), name).name not in ("eval.json", "config.yml")


def test_pieces_make_up_the_picture() -> None:
    whole = np.random.default_rng(0).integers(0, 255, (31, 50, 3), dtype=np.uint8)
    canvas = enlarged({"rgb": np.zeros((4, 7, 3), np.uint8)}, 50, 31)
    for top, bottom in ((10, 20), (0, 10), (20, 31)):
        paste(canvas, {"rgb": whole[top:bottom]}, Piece(1, 1, top, bottom))
    np.testing.assert_array_equal(canvas["rgb"], whole)
    for stride in (2, 3, 4):
        columns, rows = smaller(50, 31, stride)
        coarse = whole[:rows, :columns]
        expected = enlarged({"rgb": coarse}, 50, 31)["rgb"]
        canvas = {"rgb": np.zeros_like(whole)}
        for top, bottom in ((0, 3), (3, rows)):
            paste(canvas, {"rgb": coarse[top:bottom]}, Piece(stride, 1, top, bottom))
        np.testing.assert_array_equal(canvas["rgb"], expected)
