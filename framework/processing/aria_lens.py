"""The lens model FisheyeRadTanThinPrism of Project Aria's cameras, also called Fisheye624.

A ray at the angle t from the axis is at the distance r = t (1 + k1 t^2 + ... + k6 t^12) from the centre. With the
point p = (x, y) at that distance in the direction of the ray, and R = x^2 + y^2, the image shows the ray at f q + c,

    q = p + 2 (p1 x + p2 y) p + R (p1, p2) + R (s1, s3) + R^2 (s2, s4)

(documentation of Project Aria Tools, "Camera Intrinsic Models"). No data format of ours has this model, so images are
cut into perspective views.
"""

from __future__ import annotations

import math

import numpy as np

MODEL = "FISHEYE624"
"""Name of the model."""
RADIAL = ("k1", "k2", "k3", "k4", "k5", "k6")
"""Radial coefficients."""
NAMES = ("f", "cx", "cy", *RADIAL, "p1", "p2", "s1", "s2", "s3", "s4")
"""Numbers of a calibration in their order."""
STEPS = 1000
"""Number of angles up to 180 degrees where the slope of the radial polynomial is computed."""


def project(directions: np.ndarray, values: dict[str, float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return where a lens shows directions.

    Args:
        directions: (N, 3) in the camera's frame, OpenGL axes, of any length but 0.
        values: coefficients by their names.

    Returns:
        q, x to the right and y down, (N,) each, in focal lengths from the principal point; and (N,) bool, whether the
        radial polynomial grows up to this angle.
    """
    right, down, ahead = directions[:, 0], -directions[:, 1], -directions[:, 2]
    across = np.hypot(right, down)
    angle = np.arctan2(across, ahead)
    square = angle * angle
    radius = angle * (1 + sum(values[name] * square ** (power + 1) for power, name in enumerate(RADIAL)))
    # On the axis there is no direction, and the radius is 0.
    scale = radius / np.where(across > 0, across, 1)
    x, y = right * scale, down * scale
    p1, p2, s1, s2, s3, s4 = (values[name] for name in NAMES[9:])
    along, far = 2 * (p1 * x + p2 * y), x * x + y * y
    return (
        x + along * x + far * (p1 + s1) + far * far * s2,
        y + along * y + far * (p2 + s3) + far * far * s4,
        angle < reach(values),
    )


def reach(values: dict[str, float]) -> float:
    """Return the largest angle from the axis, radians, where the radial polynomial still grows; pi at most.

    Args:
        values: coefficients by their names.
    """
    angles = np.linspace(0, math.pi, STEPS + 1)
    slope = 1 + sum((2 * power + 3) * values[name] * angles ** (2 * power + 2) for power, name in enumerate(RADIAL))
    falling = np.flatnonzero(slope <= 0)
    return float(angles[falling[0] - 1]) if len(falling) else math.pi
