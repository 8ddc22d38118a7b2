"""Captures as other programs describe them: cameras with poses and lenses, and points, in the program's own frame."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from nerfloom.base.errors import DataError
from nerfloom.processing.finite_numbers import finite, side
from nerfloom.processing.transforms import Lens

ASPECT_TOLERANCE = 0.01
"""Relative difference between the aspect ratios of an image and its camera that rounded sizes can explain."""
FAR = 1000.0
"""A distance of this many times the spread of the cameras is far from them."""

LensOf = Callable[[int, int], Lens]
"""Function from the width and height of an image file, pixels, to its lens. It raises a DataError if these do not
fit."""


@dataclass(frozen=True)
class PosedCamera:
    """A camera with a known pose."""

    name: str
    """Name of its image as the program writes it, made relative by `relative_name`; the ending may be missing."""
    pose: np.ndarray
    """(4, 4) float64 camera-to-world, OpenGL axes, in the program's frame."""
    lens: LensOf
    """Its lens."""


@dataclass(frozen=True)
class Capture:
    """A set of photographs as a program placed it."""

    program: str
    """Name of the program, for messages."""
    cameras: list[PosedCamera]
    """The cameras with known pose and lens."""
    left_out: Counter[str]
    """Number of further cameras by the reason why they cannot be used, such as "not aligned"."""
    points: np.ndarray | None = None
    """(K, 3) float64 sparse points in the program's frame; None without."""
    colors: np.ndarray | None = None
    """(K, 3) uint8 colours of the points."""
    z_is_up: bool = False
    """Whether z is up in the frame that `frame` leads to."""
    frame: np.ndarray = field(default_factory=lambda: np.eye(4)[:3])
    """(3, 4) rigid transform from the program's frame to the one that is written."""

    @property
    def total(self) -> int:
        """Number of cameras that the program knows."""
        return len(self.cameras) + self.left_out.total()


def relative_name(name: str) -> str:
    """Return the name of an image as a relative path with slashes, without drive and parent folders.

    Programs write full paths of the machine that they ran on. Files outside of the folder of the photographs must not
    be read.

    Args:
        name: the name as written.
    """
    parts = [part for part in name.strip().replace("\\", "/").split("/") if part not in ("", ".", "..")]
    return "/".join(parts[1:] if len(parts) > 1 and parts[0].endswith(":") else parts)


def undistorted_lens(size: Iterable[Any], intrinsics: Iterable[Any]) -> Lens:
    """Return a lens without distortion, of width and height `size` and fx, fy, cx, cy `intrinsics`, pixels.

    Raises:
        TypeError, ValueError, OverflowError: if a value is invalid (`UNUSABLE`).
    """
    width, height = (side(value) for value in size)
    fx, fy, cx, cy = (finite(value) for value in intrinsics)
    if min(fx, fy) <= 0:
        raise ValueError("a focal length must be above zero")
    return Lens("OPENCV", {"w": width, "h": height, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy})


def for_size_of(lens: Lens) -> LensOf:
    """Return the function of an image's size that gives the lens `lens` for it."""
    return partial(resized, lens)


def resized(lens: Lens, width: int, height: int) -> Lens:
    """Return the `lens` of an image for its file of `width` x `height` pixels.

    Raises:
        DataError: if the aspect ratio differs.
    """
    across, down = width / lens.values["w"], height / lens.values["h"]
    if across == down == 1:
        return lens
    if abs(math.log(across / down)) > ASPECT_TOLERANCE + 1 / min(width, height):
        stated = f"{lens.values['w']}x{lens.values['h']}"
        raise DataError(f"it has {width}x{height} pixels, but its camera is for {stated}: it was cropped or rotated")
    factors = {"fl_x": across, "cx": across, "fl_y": down, "cy": down}
    values = {key: value * factors.get(key, 1) for key, value in lens.values.items()}
    return Lens(lens.model, values | {"w": width, "h": height})


def cropped(lens: Lens, crop: int) -> Lens:
    """Return the `lens` of images with `crop` pixels cut off at each side."""
    values = dict(lens.values)
    for key, change in (("w", 2 * crop), ("h", 2 * crop), ("cx", crop), ("cy", crop)):
        values[key] -= change
    return Lens(lens.model, values)


def spread_of(cameras: list[PosedCamera]) -> tuple[np.ndarray, float]:
    """Return the mean position (3,) of `cameras`, at least one, and the root mean square distance from it."""
    positions = np.stack([camera.pose[:3, 3] for camera in cameras])
    centre = positions.mean(0)
    return centre, float(np.sqrt(np.square(positions - centre).sum(1).mean()))


def near_origin(cameras: list[PosedCamera]) -> np.ndarray:
    """Return the transform (3, 4) of `Capture.frame` that moves cameras near the origin if they are far from it.

    Coordinates of maps have millions of metres, and files of points eight digits. The origin becomes the cameras' mean
    position, in whole units. Fewer than two `cameras` stay where they are.
    """
    frame = np.eye(4)[:3]
    if len(cameras) < 2:
        return frame
    centre, spread = spread_of(cameras)
    if np.linalg.norm(centre) > FAR * max(spread, 1e-9):
        frame[:, 3] = -np.round(centre)
    return frame


def check_points(capture: Capture, file: object) -> None:
    """Check that the points of `capture`, from another `file`, are in the frame of its cameras.

    Raises:
        DataError: if most of them are far from all cameras.
    """
    if capture.points is None or len(capture.points) == 0 or len(capture.cameras) < 2:
        return
    centre, spread = spread_of(capture.cameras)
    distance = float(np.median(np.linalg.norm(capture.points - centre, axis=1)))
    if distance > FAR * max(spread, 1e-9):
        raise DataError(
            f"{file}: its points are {distance:.3g} units from the cameras, which are within {spread:.3g} of each "
            f"other: another coordinate system; export both in the same, or leave out the points"
        )
