"""The path editor: paths that pass their cameras smoothly, and files that are read back."""

import math
from pathlib import Path

import pytest
import torch
from torch import Tensor

from nerfloom.cameras.camera_path import Keyframe, read_camera_path, write_camera_path
from nerfloom.cameras.poses import Placement
from nerfloom.viewer.keyframes import MAX_KEYFRAMES, Editor, through


def turned(angle: float, x: float) -> Tensor:
    """A camera that is turned about z and stands at (x, 0, 1)."""
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor([[c, -s, 0, x], [s, c, 0, 0], [0, 0, 1, 1]], dtype=torch.float64)


def editor(*angles: float, closed: bool = False, times: bool = False) -> Editor:
    frames = [Keyframe(turned(a, i), 50.0 + i, i / len(angles) if times else None) for i, a in enumerate(angles)]
    return Editor(tuple(frames), seconds=1.0, fps=10.0, closed=closed)


@pytest.mark.parametrize("closed", [False, True])
def test_the_path_passes_its_cameras_and_is_smooth(closed: bool) -> None:
    edited = editor(0.0, 0.5, 1.2, 1.3, closed=closed)
    legs = 4 if closed else 3
    places = torch.linspace(0, legs, 10 * legs + 1, dtype=torch.float64)
    path = edited.path(64, 48, None)
    assert path is not None
    assert len(path) == 10 * legs
    assert path.seconds == pytest.approx(legs)
    eye = torch.eye(3, dtype=torch.float64).expand(len(path), 3, 3)
    rotations = path.poses[:, :, :3]
    torch.testing.assert_close(rotations @ rotations.mT, eye)
    if closed:  # frames at every tenth of a leg, so that each camera is met
        for index, keyframe in enumerate(edited.keyframes):
            torch.testing.assert_close(path.poses[10 * index], keyframe.pose)
    values = torch.tensor([[0.0], [1.0], [4.0], [9.0]], dtype=torch.float64)
    curve = through(values, places, closed)[:, 0]
    torch.testing.assert_close(curve[::10][:4], values[:, 0])
    steps = curve.diff()
    assert float(steps.diff().abs().max()) < 1.0  # no jump, and no kink


def test_a_straight_line_stays_straight_and_even() -> None:
    values = torch.arange(5, dtype=torch.float64)[:, None]
    places = torch.linspace(1, 3, 21, dtype=torch.float64)
    torch.testing.assert_close(through(values, places, False)[:, 0], places)


def test_editing() -> None:
    edited = editor(0.0, 0.1, 0.2)
    assert len(edited.without(1).keyframes) == 2
    assert edited.without(7) == edited
    assert edited.moved(-1, edited.keyframes[0]) == edited
    assert edited.moved(2, edited.keyframes[0]).keyframes[2] is edited.keyframes[0]
    full = edited
    for _ in range(MAX_KEYFRAMES + 5):
        full = full.added(edited.keyframes[0])
    assert len(full.keyframes) == MAX_KEYFRAMES
    assert Editor().path(64, 48, None) is None
    video = Editor(edited.keyframes[:2]).path(64, 48, None)  # as it is at first: 2 s at 30 frames/s
    assert video is not None
    assert (len(video), video.fps) == (60, pytest.approx(30))


def test_the_file_is_read_back(tmp_path: Path) -> None:
    path = editor(0.0, 0.4, 1.0, times=True).path(64, 48, Placement(torch.eye(4, dtype=torch.float64)[:3], 0.5))
    assert path is not None
    write_camera_path(tmp_path / "camera_path.json", path)
    back = read_camera_path(tmp_path / "camera_path.json")
    torch.testing.assert_close(back.poses, path.poses)
    torch.testing.assert_close(back.times, path.times)
    assert len(back.keyframes) == 3
    assert back.placement is not None
    assert back.fps == pytest.approx(10)
