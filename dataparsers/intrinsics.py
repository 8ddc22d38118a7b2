"""Intrinsics in a transforms file: for all frames, per frame, or as an angle of view."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from nerfloom import DataError
from nerfloom.base.console import say
from nerfloom.base.errors import shown
from nerfloom.base.json_files import number
from nerfloom.dataparsers.captured import sizes_of
from nerfloom.dataparsers.posed_images import Lenses
from nerfloom.dataparsers.reading import Frames, numbers, side_or_none

PERSPECTIVE = ("opencv", ("k1", "k2", "p1", "p2", "k3", "", "", "", "k4"))
"""Projection, and the file's names of its coefficients in the order of `LENSES`."""
FISHEYE = ("fisheye", ("k1", "k2", "k3", "k4"))
"""Projection and names of coefficients for a fisheye lens."""
CAMERA_MODELS: dict[str, tuple[str, tuple[str, ...]]] = {
    **dict.fromkeys(("PERSPECTIVE", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"), PERSPECTIVE),
    **dict.fromkeys(("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"), FISHEYE),
    "FULL_OPENCV": ("opencv", ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "")),
    "EQUIRECTANGULAR": ("equirectangular", ()),
    "ORTHOGRAPHIC": ("orthographic", ()),
    "ORTHOPHOTO": ("orthographic", ()),
}
"""`camera_model` -> projection, and the file's name of each coefficient of `LENSES`; '' if it has none."""
MIN_ANGLE = 1e-6
"""Minimum angle of view, radians; for smaller angles the focal length exceeds float32."""
SAME_FOCAL = 0.01
"""Relative difference between a focal length and the one from an angle of view that counts as rounding."""
NGP_SCALE = 0.33
NGP_OFFSET = [0.5, 0.5, 0.5]
"""instant-ngp maps a position x of the file to `scale * x + offset` in its unit cube; these are its defaults."""


def read_intrinsics(
    file: Path, content: dict[str, Any], frames: Frames, unstated: Callable[[], Tensor], quiet: bool
) -> Lenses:
    """Return the intrinsics stated in a transforms file, and report a focal length that contradicts an angle in it.

    A frame's own values take precedence over values for all frames, and a focal length over an angle of view. The
    principal point defaults to the image's centre. The focal length along one axis defaults to that along the other.

    Args:
        file: the file, for messages.
        content: the file's JSON object.
        frames: M frames.
        unstated: returns width and height (M, 2) int64 of the images; called if the file does not state all of them.
        quiet: whether to report nothing.

    Raises:
        DataError: if a value is invalid, or there is no focal length.
    """
    sizes = sizes_of(
        [[side_or_none(_value(frame, content, key), key, label) for key in "wh"] for frame, label in frames], unstated
    )
    model, keys = _camera_model(file, content, frames)
    values = [_values(*pair, content, size, model) for pair, size in zip(frames, sizes.tolist(), strict=True)]
    lens = [[_number(frame, content, key, label) or 0.0 for key in keys] for frame, label in frames]
    warnings = (_contradiction(*pair, content, size) for pair, size in zip(frames, sizes.tolist(), strict=True))
    warning = None if model == "equirectangular" else next(filter(None, warnings), None)
    if warning and not quiet:
        say(warning)
    return Lenses(torch.tensor(values, dtype=torch.float64), sizes, model, torch.tensor(lens) if keys else None)


def ngp_cube(content: dict[str, Any], file: Path) -> tuple[Tensor, float] | None:
    """Return centre (3,) float64 and edge of instant-ngp's cube in `content` of `file`; None without `aabb_scale`.

    Raises:
        DataError: if 'aabb_scale', 'scale' or 'offset' is invalid.
    """
    if content.get("aabb_scale") is None:
        return None
    unit = number(content.get("scale", NGP_SCALE), "scale", str(file), positive=True)
    edge = number(content["aabb_scale"], "aabb_scale", str(file), positive=True) / unit
    offset = numbers(content.get("offset", NGP_OFFSET), 3, "offset", str(file))
    return (0.5 - torch.tensor(offset, dtype=torch.float64)) / unit, edge


def _value(frame: dict[str, Any], content: dict[str, Any], key: str) -> Any:
    """Return a frame's own value, otherwise the file's value for all frames; None if both are missing."""
    own = frame.get(key)
    return content.get(key) if own is None else own


def _number(frame: dict[str, Any], content: dict[str, Any], key: str, label: str) -> float | None:
    value = _value(frame, content, key)
    return None if value is None else number(value, key, label)


def _camera_model(file: Path, content: dict[str, Any], frames: Frames) -> tuple[str, tuple[str, ...]]:
    """Return the projection of all frames, and the names of its coefficients in the file."""
    if content.get("is_fisheye") is True:  # instant-ngp's key
        return FISHEYE
    given = [_value(frame, content, "camera_model") or "PERSPECTIVE" for frame, _ in frames]
    named = {name if isinstance(name, str) else shown(name) for name in given}
    for name in sorted(named - set(CAMERA_MODELS)):
        raise DataError(f"{file}: unknown camera_model '{shown(name)[1:-1]}'; known: {', '.join(CAMERA_MODELS)}")
    models = {CAMERA_MODELS[name] for name in named}
    if len(models) > 1:
        raise DataError(f"{file} mixes the camera models {' and '.join(sorted(named))}; split it into a file for each")
    return models.pop()


def _values(
    frame: dict[str, Any], label: str, content: dict[str, Any], size: list[int], model: str
) -> tuple[float, float, float, float]:
    """Return fx, fy, cx, cy in pixels of an image of `size`."""
    fx, fy = (_focal(frame, content, axis, length, label) for axis, length in zip("xy", size, strict=True))
    if model == "equirectangular":  # in the file, half the width of a whole panorama; here, pixels per radian
        fx, fy = (fx or fy or size[0] / 2) / math.pi, (fy or fx or size[1]) / math.pi
    elif fx is None and fy is None:
        raise DataError(f"{label}: there is no focal length, neither 'fl_x' nor 'camera_angle_x'")
    cx, cy = (_number(frame, content, key, label) for key in ("cx", "cy"))
    return (fx or fy or 0.0, fy or fx or 0.0, size[0] / 2 if cx is None else cx, size[1] / 2 if cy is None else cy)


def _focal(frame: dict[str, Any], content: dict[str, Any], axis: str, length: int, label: str) -> float | None:
    """Return the focal length in pixels along an axis of `length` pixels; None if the file does not state it."""
    for source in (frame, content):  # a frame's own angle takes precedence over the focal length of all frames
        if source.get(f"fl_{axis}") is not None:
            return number(source[f"fl_{axis}"], f"fl_{axis}", label, positive=True)
        if source.get(f"camera_angle_{axis}") is not None:
            return _focal_of_angle(source, axis, length, label)
    return None


def _focal_of_angle(source: dict[str, Any], axis: str, length: int, label: str) -> float:
    """Return the focal length in pixels for the angle of view along an axis of `length` pixels."""
    name = f"camera_angle_{axis}"
    angle = number(source[name], name, label, positive=True)
    if not MIN_ANGLE < angle < math.pi:
        raise DataError(f"{label}: '{name}' is {angle}; it must be an angle between 0 and pi radians")
    return 0.5 * length / math.tan(0.5 * angle)


def _contradiction(frame: dict[str, Any], label: str, content: dict[str, Any], size: list[int]) -> str | None:
    """Return a message if a focal length and the angle of view beside it differ; None otherwise.

    Only the horizontal angle is compared: Blender's `angle_y` belongs to its sensor, not to the image's height.
    """
    for source in (frame, content):
        if source.get("fl_x") is None or source.get("camera_angle_x") is None:
            continue
        focal = number(source["fl_x"], "fl_x", label, positive=True)
        other = _focal_of_angle(source, "x", size[0], label)
        if abs(math.log(focal / other)) > SAME_FOCAL:
            return (
                f"warning: {label}: 'fl_x' is {focal:.6g}, but 'camera_angle_x' gives {other:.6g} for a width of "
                f"{size[0]} pixels; using fl_x"
            )
    return None
