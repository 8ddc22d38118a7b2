"""Lenses of Agisoft Metashape's sensors.

The camera models are in the appendix "Camera models" of its user manual: x' and y' are distorted coordinates of the
image plane, for fisheyes by the angle to the optical axis, and

    u = w / 2 + cx + x' (f + B1) + y' B2,   v = h / 2 + cy + y' f,
    x' = x (1 + K1 r^2 + K2 r^4 + K3 r^6 + K4 r^8) + (P1 (r^2 + 2 x^2) + 2 P2 x y) (1 + P3 r^2 + P4 r^4),
    y' = y (1 + K1 r^2 + K2 r^4 + K3 r^6 + K4 r^8) + (P2 (r^2 + 2 y^2) + 2 P1 x y) (1 + P3 r^2 + P4 r^4).

The centre of the first pixel is at 0.5. OpenCV's p1 is P2, and its p2 is P1.
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
MAX_DISPLACEMENT = 0.5
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
        UnsupportedSensor: if the lens cannot be expressed, or was not calibrated.
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
    shift = displacement(given, width, height, kind in FISHEYES)
    if not shift <= MAX_DISPLACEMENT:
        terms = "B2, P1 to P4" if kind in FISHEYES else "B2, P3 or P4"
        raise UnsupportedSensor(f"of sensors whose {terms} displace pixels by up to {shift:.2g} (align without them)")
    values = {
        "w": width, "h": height, "fl_x": given["f"] + given["b1"], "fl_y": given["f"],
        "cx": width / 2 + given["cx"], "cy": height / 2 + given["cy"],
        **{key: given[key] for key in ("k1", "k2", "k3", "k4")},
    }  # fmt: skip
    if values["fl_x"] <= 0 or values["fl_y"] <= 0:
        raise DataError(f"{where}: the focal length f, or f + b1, is not above zero")
    if kind in FISHEYES:
        return Lens("OPENCV_FISHEYE", values)
    # transforms.json calls the r^8 term k4, as Metashape does.
    return Lens("OPENCV", values | {"p1": given["p2"], "p2": given["p1"]})


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
