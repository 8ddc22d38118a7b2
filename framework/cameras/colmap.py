"""Conversion of COLMAP's camera models. Pixel coordinates agree: COLMAP also places pixel centres at 0.5."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from nerfloom.base.errors import DataError
from nerfloom.cameras.cameras import MAX_SIDE
from nerfloom.geometry.lenses import LENSES

PARAMETERS: dict[str, tuple[str, str]] = {
    "SIMPLE_PINHOLE": ("pinhole", "f cx cy"),
    "PINHOLE": ("pinhole", "fx fy cx cy"),
    "SIMPLE_RADIAL": ("opencv", "f cx cy k1"),
    "RADIAL": ("opencv", "f cx cy k1 k2"),
    "OPENCV": ("opencv", "fx fy cx cy k1 k2 p1 p2"),
    "FULL_OPENCV": ("opencv", "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    "SIMPLE_RADIAL_FISHEYE": ("fisheye", "f cx cy k1"),
    "RADIAL_FISHEYE": ("fisheye", "f cx cy k1 k2"),
    "OPENCV_FISHEYE": ("fisheye", "fx fy cx cy k1 k2 k3 k4"),
}
"""COLMAP's model -> projection of `LENSES`, and the names of COLMAP's parameters in their order."""


class Intrinsics(NamedTuple):
    """Intrinsics of one camera, as `Cameras` takes them.

    Args:
        fx: horizontal focal length, pixels.
        fy: vertical focal length, pixels.
        cx: principal point's column, pixels.
        cy: principal point's row, pixels.
    """

    model: str
    """A key of `LENSES`."""
    fx: float
    fy: float
    cx: float
    cy: float
    lens: tuple[float, ...]
    """Distortion coefficients, in the order of `LENSES[model]`."""


def from_colmap(model_name: str, params: Sequence[float], width: int, height: int) -> Intrinsics:
    """Convert COLMAP's camera `model_name` of `params`, `width`, `height`; opencv without distortion is a pinhole.

    Raises:
        DataError: if the model is not one of `PARAMETERS`, or its parameters are invalid.
    """
    if model_name not in PARAMETERS:
        raise DataError(
            f"COLMAP's camera model {model_name} is not supported (supported are {', '.join(PARAMETERS)}); "
            "undistort the images with 'colmap image_undistorter'"
        )
    model, listed = PARAMETERS[model_name]
    names = listed.split()
    if len(params) != len(names):
        raise DataError(f"COLMAP's camera model {model_name} has {len(names)} parameters ({listed}), not {len(params)}")
    values = dict(zip(names, (float(value) for value in params), strict=True))
    fx, fy = values.get("fx", values.get("f", 0.0)), values.get("fy", values.get("f", 0.0))
    finite = all(math.isfinite(value) for value in values.values())
    if not finite or min(fx, fy, width, height) <= 0 or max(width, height) > MAX_SIDE:
        numbers = " ".join(f"{name}={value:g}" for name, value in values.items())
        raise DataError(
            f"a COLMAP camera of model {model_name} is invalid: {width}x{height} pixels, {numbers}; "
            "sizes and focal lengths must be positive, and every number finite"
        )
    lens = tuple(values.get(name, 0.0) for name in LENSES[model])
    if model == "opencv" and not any(lens):
        model, lens = "pinhole", ()
    return Intrinsics(model, fx, fy, values["cx"], values["cy"], lens)
