"""The path editor: added cameras, the smooth path through them, and its file in the run's folder."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from nerfloom.cameras.camera_path import CameraPath, Keyframe
from nerfloom.cameras.poses import Placement
from nerfloom.geometry.alignment import nearest_rotations
from nerfloom.video.settings import FramesSettings

MAX_KEYFRAMES = 500
"""Maximum number of cameras on a path."""
MAX_FRAMES = 20_000
"""Maximum number of frames on a path."""
MAX_NAME_LENGTH = 40
"""Maximum length of a path's name, characters."""


@dataclass(frozen=True)
class Editor:
    """Cameras of a path, and the timing of its video."""

    keyframes: tuple[Keyframe, ...] = ()
    """Cameras in path order."""
    seconds: float = 2.0
    """Seconds from one camera to the next."""
    fps: float = FramesSettings.fps
    """Frames per second; by default as in videos of `ns-render`."""
    closed: bool = False
    """Whether the path returns to the first camera."""

    def added(self, keyframe: Keyframe) -> Editor:
        """Return the path with a `keyframe` appended; unchanged if it is full."""
        if len(self.keyframes) >= MAX_KEYFRAMES:
            return self
        return replace(self, keyframes=(*self.keyframes, keyframe))

    def without(self, index: int) -> Editor:
        """Return the path without camera `index`; unchanged if there is none."""
        if not 0 <= index < len(self.keyframes):
            return self
        return replace(self, keyframes=self.keyframes[:index] + self.keyframes[index + 1 :])

    def moved(self, index: int, keyframe: Keyframe) -> Editor:
        """Return the path with camera `index` replaced by a `keyframe`; unchanged if there is none."""
        if not 0 <= index < len(self.keyframes):
            return self
        return replace(self, keyframes=(*self.keyframes[:index], keyframe, *self.keyframes[index + 1 :]))

    def path(self, width: int, height: int, placement: Placement | None) -> CameraPath | None:
        """Return the path's frames of `width` x `height` pixels by `placement`; None with fewer than two cameras."""
        count = len(self.keyframes)
        if count < 2:
            return None
        legs = count if self.closed else count - 1
        frames = min(max(round(legs * self.seconds * self.fps), 2), MAX_FRAMES)
        places = torch.linspace(0, legs, frames + self.closed, dtype=torch.float64)[:frames]
        known = [one.time for one in self.keyframes if one.time is not None]
        times = None
        if len(known) == count:
            times = through(torch.tensor(known, dtype=torch.float64)[:, None], places, self.closed)[:, 0]
        fovs = torch.tensor([one.fov for one in self.keyframes], dtype=torch.float64)
        return CameraPath(
            camera_type="perspective",
            width=width,
            height=height,
            poses=poses_through(torch.stack([one.pose for one in self.keyframes]), places, self.closed),
            fovs=through(fovs[:, None], places, self.closed)[:, 0].clamp(0.5, 170.0),
            seconds=frames / self.fps,
            times=None if times is None else times.clamp(0, 1).float(),
            is_cycle=self.closed,
            keyframes=self.keyframes,
            placement=placement,
        )


def through(values: Tensor, places: Tensor, closed: bool) -> Tensor:
    """Return values on the Catmull-Rom spline through given values (Catmull and Rom 1974).

    Args:
        values: (K, ...) given values.
        places: (F,) positions along the curve: 0 at the first value, 1 at the second.
        closed: whether the first value follows the last; otherwise the ends are repeated.

    Returns:
        (F, ...) values.
    """
    count = len(values)
    first = places.floor().long().clamp(0, count - 1 if closed else max(count - 2, 0))
    t = (places - first).view(-1, *[1] * (values.ndim - 1))
    picked = []
    for shift in (-1, 0, 1, 2):
        index = first + shift
        picked.append(values[index % count if closed else index.clamp(0, count - 1)])
    before, start, end, after = picked
    slope, next_slope = (end - before) / 2, (after - start) / 2
    return (
        (2 * t**3 - 3 * t**2 + 1) * start
        + (t**3 - 2 * t**2 + t) * slope
        + (3 * t**2 - 2 * t**3) * end
        + (t**3 - t**2) * next_slope
    )


def poses_through(poses: Tensor, places: Tensor, closed: bool) -> Tensor:
    """Return poses on a smooth path through `poses` (K, 3, 4) float64; `places` and `closed` are as in `through`.

    Positions and rotation matrices are on splines; a rotation is the one closest to its matrix. Between two neighbours
    that look in opposite directions, the path is arbitrary.
    """
    matrices = through(poses, places, closed)
    return torch.cat([nearest_rotations(matrices[:, :, :3]), matrices[:, :, 3:]], dim=-1)


def path_file(folder: Path, name: object) -> Path:
    """Return the file of a camera path in a run's folder: camera_path.json, or camera_path-NAME.json.

    Only ASCII letters, digits, - and _ of the name are used, so that it cannot refer to another file or folder.

    Args:
        folder: the run's folder.
        name: name sent by a browser.
    """
    kept = re.sub(r"[^A-Za-z0-9_-]", "", name)[:MAX_NAME_LENGTH] if isinstance(name, str) else ""
    return folder / (f"camera_path-{kept}.json" if kept and kept != "camera_path" else "camera_path.json")


def listed(editor: Editor) -> Sequence[str]:
    """Return the names of an `editor`'s cameras for a list: 1, 2, 3, ..."""
    return [str(index + 1) for index in range(len(editor.keyframes))]
