"""Requests of browsers: a camera, an output, and display options. All values are validated."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.ndc import Ndc, NdcCameras
from nerfloom.geometry.regions import Box, Polygon

MAX_COORDINATE = 1e6
"""Maximum coordinate of a camera, scene units."""
FIELDS_OF_VIEW = (0.5, 170.0)
"""Range of the vertical field of view, degrees."""
MAX_SIDE, MIN_SIDE = 4096, 8
"""Range of the width and height of a picture, pixels."""
OUTPUTS = ("rgb", "depth", "accumulation", "error")
"""Outputs available for every method; a method may declare others."""


@dataclass(frozen=True)
class Pose:
    """Position and orientation of a browser's camera, and its lens."""

    matrix: tuple[float, ...]
    """12 numbers, camera-to-scene (3, 4) row by row, OpenGL axes."""
    fov: float
    """Vertical field of view, radians."""

    def tensor(self) -> Tensor:
        """Return the pose (3, 4) float64."""
        return torch.tensor(self.matrix, dtype=torch.float64).view(3, 4)


@dataclass(frozen=True)
class Crop:
    """Visible part of space."""

    box: Box | None = None
    """The box, in the frame of the scene; None for all of space."""
    near: float = 0.0
    """Nothing nearer to the camera is shown, scene units."""
    far: float = math.inf
    """Nothing farther from the camera is shown, scene units."""
    polygons: tuple[Polygon, ...] = ()
    """Polygons on views of pinholes, in the frame of the scene. What is in all of them is shown."""

    def contains(self, points: Tensor) -> Tensor:
        """Return whether `points` (N, 3) are in the box and in all polygons, (N,) bool."""
        inside = torch.ones(len(points), dtype=torch.bool, device=points.device)
        for region in (*self.polygons, *(() if self.box is None else (self.box,))):
            inside &= region.contains(points)
        return inside

    def moved(self, rotation: Tensor, scale: float, shift: Tensor) -> Crop:
        """Return the crop after a similarity transform; `rotation`, `scale` and `shift` are as in `Request.moved`."""
        box = None if self.box is None else self.box.moved(rotation, scale, shift)
        polygons = tuple(polygon.moved(rotation, scale, shift) for polygon in self.polygons)
        return Crop(box, scale * self.near, scale * self.far, polygons)


@dataclass(frozen=True)
class Request:
    """A view requested by a browser."""

    pose: Pose
    """Camera."""
    width: int
    """Width of the finished picture, pixels."""
    height: int
    """Height of the finished picture, pixels."""
    output: str = "rgb"
    """Name of the output: one of `OUTPUTS`, or one declared by the method."""
    time: float | None = None
    """Time in [0, 1]; None for a static scene. A moving scene beside a static one is then shown at time 0."""
    appearance: int | None = None
    """Training image that gives the appearance; None for the mean."""
    background: tuple[float, float, float] | None = None
    """Colour behind the scene, 0 to 1; None for the evaluation background."""
    crop: Crop | None = None
    """Visible part of space; None for all."""
    overlay: float = 0.0
    """Opacity of the photograph over the colours, 0 to 1, if one was taken from the camera."""
    divider: float | None = None
    """Width of the first run's part, as a fraction of the picture; None for a single run."""

    def moved(self, rotation: Tensor, scale: float, shift: Tensor) -> Request:
        """Return the same view after a similarity transform of its scene, x -> scale * rotation @ x + shift.

        Args:
            rotation: (3, 3) rotation, float64, on the CPU.
            scale: factor of lengths.
            shift: (3,) shift, float64, on the CPU.
        """
        pose = self.pose.tensor()
        place = scale * (rotation @ pose[:, 3]) + shift
        matrix = torch.cat([rotation @ pose[:, :3], place[:, None]], dim=1)
        crop = None if self.crop is None else self.crop.moved(rotation, scale, shift)
        return replace(self, pose=Pose(tuple(matrix.flatten().tolist()), self.pose.fov), crop=crop)

    def camera(self, stride: int = 1, rows: tuple[int, int] | None = None, ndc: Ndc | None = None) -> Cameras:
        """Return the camera of a smaller picture of the same view, or of some of its rows.

        Args:
            stride: width and height are divided by it and rounded up.
            rows: first row and the one after the last; None for all.
            ndc: normalised device coordinates of the scene; None if it has none.
        """
        width, height = smaller(self.width, self.height, stride)
        top, bottom = rows or (0, height)
        focal = 0.5 * self.height / math.tan(0.5 * self.pose.fov)
        numbers = {
            "fx": focal * width / self.width,
            "fy": focal * height / self.height,
            "cx": 0.5 * width,
            "cy": 0.5 * height - top,
        }
        values: dict[str, Any] = {name: torch.tensor([value]) for name, value in numbers.items()}
        values |= {"widths": torch.tensor([width]), "heights": torch.tensor([bottom - top])}
        poses = self.pose.tensor().float()[None]
        if ndc is not None:
            return NdcCameras(poses, **values, ndc=ndc)
        return Cameras(poses, **values)


def smaller(width: int, height: int, stride: int) -> tuple[int, int]:
    """Return the size of a picture of `width` x `height` pixels at a `stride`, which divides both, rounded up."""
    return -(-width // stride), -(-height // stride)


def pose_of(wxyz: Any, position: Any, fov: Any) -> Pose | None:
    """Return the camera that a browser reports; None if the numbers are invalid.

    `wxyz` is the quaternion from its axes (x right, y down, z ahead) to the scene, `position` has three
    coordinates, `fov` is vertical, in radians.
    """
    quaternion, place, angle = _numbers(wxyz, 4), _numbers(position, 3), _numbers([fov], 1)
    if quaternion is None or place is None or angle is None:
        return None
    length = math.hypot(*quaternion)
    if not 1e-6 < length < 1e6 or max(map(abs, place)) > MAX_COORDINATE:
        return None
    w, x, y, z = (value / length for value in quaternion)
    rotation = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    matrix = [
        number for (right, down, ahead), t in zip(rotation, place, strict=True) for number in (right, -down, -ahead, t)
    ]
    least, most = map(math.radians, FIELDS_OF_VIEW)
    return Pose(tuple(matrix), min(max(angle[0], least), most))


def quaternion_of(pose: Tensor) -> tuple[float, float, float, float]:
    """Return the w, x, y, z of `pose` (3, 4) with axes x right, y down, z forward; the inverse of `pose_of`."""
    m = (pose[:, :3].double() * torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)).tolist()
    trace = m[0][0] + m[1][1] + m[2][2]
    # Divide by the largest of the four squares, so that nothing is divided by zero.
    squares = [1 + trace, *(1 - trace + 2 * m[i][i] for i in range(3))]
    largest = squares.index(max(squares))
    twice = math.sqrt(squares[largest])
    s = 0.5 / twice
    if largest == 0:
        found = (0.5 * twice, (m[2][1] - m[1][2]) * s, (m[0][2] - m[2][0]) * s, (m[1][0] - m[0][1]) * s)
    elif largest == 1:
        found = ((m[2][1] - m[1][2]) * s, 0.5 * twice, (m[0][1] + m[1][0]) * s, (m[0][2] + m[2][0]) * s)
    elif largest == 2:
        found = ((m[0][2] - m[2][0]) * s, (m[0][1] + m[1][0]) * s, 0.5 * twice, (m[1][2] + m[2][1]) * s)
    else:
        found = ((m[1][0] - m[0][1]) * s, (m[0][2] + m[2][0]) * s, (m[1][2] + m[2][1]) * s, 0.5 * twice)
    return found


def size_of(width: Any, height: Any, longest: int) -> tuple[int, int]:
    """Return the size of the finished picture in a browser's window.

    Args:
        width, height: size of the window, pixels; invalid values count as 4:3.
        longest: maximum of width and height, pixels.
    """
    numbers = _numbers([width, height], 2)
    w, h = (4.0, 3.0) if numbers is None or min(numbers) < 1 or max(numbers) > 1e5 else numbers
    factor = min(longest, max(w, h) if numbers is not None else longest, MAX_SIDE) / max(w, h)
    return max(round(w * factor), MIN_SIDE), max(round(h * factor), MIN_SIDE)


def number_in(value: Any, least: float, most: float, default: float) -> float:
    """Return a browser's `value` as a number from `least` to `most`; `default` if it is not a finite number."""
    found = _numbers([value], 1)
    return default if found is None else min(max(found[0], least), most)


def one_of(value: Any, choices: Sequence[str]) -> str:
    """Return a browser's `value` if it is among `choices`, otherwise the first choice."""
    return value if isinstance(value, str) and value in choices else choices[0]


def color_of(value: Any) -> tuple[float, float, float]:
    """Return a browser's `value`, three numbers from 0 to 255, as a colour in [0, 1]; white if invalid."""
    found = _numbers(value, 3)
    red, green, blue = (1.0, 1.0, 1.0) if found is None else (min(max(part / 255, 0.0), 1.0) for part in found)
    return red, green, blue


def corner_of(value: Any, default: Sequence[float]) -> tuple[float, float, float]:
    """Return a browser's `value` as a point; the coordinates `default` if it is invalid."""
    found = _numbers(value, 3)
    x, y, z = default if found is None else (min(max(part, -MAX_COORDINATE), MAX_COORDINATE) for part in found)
    return x, y, z


def _numbers(values: Any, count: int) -> list[float] | None:
    """Return `count` finite numbers; None for anything else."""
    try:
        found = [float(value) for value in values if not isinstance(value, (bool, str, bytes))]
    except (TypeError, ValueError, OverflowError):
        return None
    return found if len(found) == count and all(map(math.isfinite, found)) else None
