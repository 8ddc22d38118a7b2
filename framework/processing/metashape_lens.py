"""Lenses of Agisoft Metashape's sensors.

The camera models are in the appendix "Camera models" of its user manual: x' and y' are distorted coordinates of the
image plane, for fisheyes by the angle to the optical axis, and

    u = w / 2 + cx + x' (f + B1) + y' B2,   v = h / 2 + cy + y' f,
    x' = x (1 + K1 r^2 + K2 r^4 + K3 r^6 + K4 r^8) + (P1 (r^2 + 2 x^2) + 2 P2 x y) (1 + P3 r^2 + P4 r^4),
    y' = y (1 + K1 r^2 + K2 r^4 + K3 r^6 + K4 r^8) + (P2 (r^2 + 2 y^2) + 2 P1 x y) (1 + P3 r^2 + P4 r^4).

The centre of the first pixel is at 0.5. OpenCV's p1 is P2, and its p2 is P1.

A data folder has no place for B2, P3 and P4, nor for P1 and P2 of a fisheye. Where these terms displace a pixel, the
lens keeps them, and its images are resampled to those of the `nearest` lens without them.
"""

from __future__ import annotations

import math
from xml.etree.ElementTree import Element

import numpy as np

from nerfloom.base.errors import DataError, shown
from nerfloom.processing.finite_numbers import UNUSABLE, bounded, side
from nerfloom.processing.transforms import Lens

FISHEYES = ("fisheye", "equidistant_fisheye")
"""Types of sensors with the equidistant fisheye model; the second is its name since version 2.3."""
TYPES = ("frame", *FISHEYES, "spherical")
"""Types of sensors that are supported."""
COEFFICIENTS = ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")
"""Numbers of a calibration; missing ones are 0."""
SIDES = ("width", "height")
"""Attributes of a resolution."""
FRAME, FISHEYE = "METASHAPE", "METASHAPE_FISHEYE"
"""Names of the models of lenses with all of Metashape's terms."""
NEAREST = {FRAME: "OPENCV", FISHEYE: "OPENCV_FISHEYE"}
"""Model with all terms -> model of transforms.json with most of them."""
REST = {FRAME: ("skew", "p3", "p4"), FISHEYE: ("skew", "p1", "p2", "p3", "p4")}
"""Model with all terms -> names of those that transforms.json has no place for."""
MAX_DISPLACEMENT = 0.1
"""Maximum displacement of a pixel by terms that are left out, pixels."""
MAX_TANGENT = 100.0
"""Maximum coordinate of the image plane where the displacement is computed; its angle to the axis is 89.4 degrees."""
POSITIONS = 33
"""Number of positions along each side of an image where the displacement is computed."""


class UnsupportedSensor(Exception):
    """An error for a sensor with an unusable lens; its text follows a number of cameras, such as "of X sensors"."""


def lens_of(sensor: Element, where: str) -> Lens:
    """Return the lens of a `sensor` element of cameras.xml, named by `where` in messages.

    Raises:
        UnsupportedSensor: if the type of sensor is not supported, or it was not calibrated.
        DataError: if a number is missing or invalid.
    """
    kind = sensor.get("type", "frame")
    if kind not in TYPES:
        raise UnsupportedSensor(f"of {shown(kind)} sensors")
    calibration = _calibration(sensor)
    if calibration is None and kind != "spherical":
        raise UnsupportedSensor("of sensors without calibration")
    width, height = _size(sensor, calibration, where)
    if calibration is None or kind == "spherical":
        half = width / 2
        values = {"w": width, "h": height, "fl_x": half, "fl_y": half, "cx": half, "cy": height / 2}
        return Lens("EQUIRECTANGULAR", values)
    given = _coefficients(calibration, where)
    values = {
        "w": width, "h": height, "fl_x": given["f"] + given["b1"], "fl_y": given["f"],
        "cx": width / 2 + given["cx"], "cy": height / 2 + given["cy"],
        **{key: given[key] for key in ("k1", "k2", "k3", "k4")},
    }  # fmt: skip
    if values["fl_x"] <= 0 or values["fl_y"] <= 0:
        raise DataError(f"{where}: the focal length f, or f + b1, is not above zero")
    # transforms.json calls the r^8 term k4, as Metashape does.
    values |= {"p1": given["p2"], "p2": given["p1"]}
    values |= {"skew": given["b2"] / values["fl_x"], "p3": given["p3"], "p4": given["p4"]}
    lens = Lens(FISHEYE if kind in FISHEYES else FRAME, values)
    exact = displacement(given, width, height, kind in FISHEYES) <= MAX_DISPLACEMENT
    return nearest(lens) if exact else lens


def nearest(lens: Lens) -> Lens:
    """Return the lens of transforms.json that differs least from `lens`: itself, if it is one already."""
    if lens.model not in NEAREST:
        return lens
    rest = REST[lens.model]
    return Lens(NEAREST[lens.model], {name: value for name, value in lens.values.items() if name not in rest})


def project(
    directions: np.ndarray, values: dict[str, float], fisheye: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return where a lens with all terms shows directions.

    Args:
        directions: (N, 3) in the camera's frame, OpenGL axes, of any length but 0.
        values: coefficients by their names, p1 and p2 as OpenCV has them.
        fisheye: whether the lens is a fisheye.

    Returns:
        x to the right and y down, (N,) each, in focal lengths from the principal point; and (N,) bool, whether the
        direction is one that the lens can show.
    """
    right, down, ahead = directions[:, 0], -directions[:, 1], -directions[:, 2]
    across = np.hypot(right, down)
    if fisheye:
        visible = (across > 0) | (ahead > 0)
        scale = np.arctan2(across, ahead) / np.where(across > 0, across, 1)
    else:
        visible = ahead > 0
        scale = 1 / np.where(visible, ahead, 1)
    x, y = right * scale, down * scale
    squared = x * x + y * y
    k1, k2, k3, k4, p1, p2, p3, p4 = (values[name] for name in ("k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4"))
    radial = 1 + squared * (k1 + squared * (k2 + squared * (k3 + squared * k4)))
    more = 1 + squared * (p3 + squared * p4)
    u = x * radial + (p2 * (squared + 2 * x * x) + 2 * p1 * x * y) * more
    v = y * radial + (p1 * (squared + 2 * y * y) + 2 * p2 * x * y) * more
    return u + values["skew"] * v, v, visible


def displacement(given: dict[str, float], width: int, height: int, fisheye: bool) -> float:
    """Return the largest displacement of a pixel by the terms that transforms.json has no place for, pixels.

    These are B2, P3 and P4, and of a fisheye P1 and P2 too.

    Args:
        given: the coefficients by name.
        width, height: size of the images, pixels.
        fisheye: whether the lens is a fisheye.
    """
    if given["f"] <= 0:
        return 0.0
    limit = math.pi if fisheye else MAX_TANGENT
    half_x = min((width / 2 + abs(given["cx"])) / given["f"], limit)
    half_y = min((height / 2 + abs(given["cy"])) / given["f"], limit)
    x, y = np.meshgrid(np.linspace(-half_x, half_x, POSITIONS), np.linspace(-half_y, half_y, POSITIONS))
    squared = x * x + y * y
    lost = given["p3"] * squared + given["p4"] * squared**2 + (1 if fisheye else 0)
    across = lost * (given["p1"] * (squared + 2 * x * x) + 2 * given["p2"] * x * y)
    down = lost * (given["p2"] * (squared + 2 * y * y) + 2 * given["p1"] * x * y)
    return float(np.hypot(across * given["f"] + given["b2"] * y, down * given["f"]).max())


def _calibration(sensor: Element) -> Element | None:
    """Return the adjusted calibration of a sensor; another one if there is none, or None."""
    found = sensor.findall("calibration")
    return next((each for each in found if each.get("class") == "adjusted"), found[0] if found else None)


def _size(sensor: Element, calibration: Element | None, where: str) -> tuple[int, int]:
    inside = None if calibration is None else calibration.find("resolution")
    resolution = sensor.find("resolution") if inside is None else inside
    try:
        width, height = (side((resolution.attrib if resolution is not None else {})[key]) for key in SIDES)
    except UNUSABLE as error:
        raise DataError(f"{where} has no resolution with width and height") from error
    return width, height


def _coefficients(calibration: Element, where: str) -> dict[str, float]:
    if calibration.find("f") is None:
        raise DataError(f"{where} has a calibration without f; export the cameras by PhotoScan 1.2 or later")
    try:
        return {name: bounded(calibration.findtext(name) or 0) for name in COEFFICIENTS}
    except UNUSABLE as error:
        raise DataError(f"{where} has a calibration with a number that is not finite") from error
