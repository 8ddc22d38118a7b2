"""A capture with a known truth: a patterned ball, photographed from all around through a known lens.

Made without any of the framework's mathematics. A photograph's pixel has the colour that the ray through its centre
meets, so whoever reads a capture rightly finds, along the ray of every pixel, the very colour that the pixel has; half
a pixel, a coefficient or an axis that is wrong shows at once (`test_captures.py`).
"""

import math
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from PIL import Image

CENTRE, RADIUS = np.array([0.4, -0.3, 0.7]), 0.5
"""Centre and radius of the ball, in the capture's own frame and unit (metres)."""
WIDTH, HEIGHT = 48, 40
INTRINSICS = (70.0, 73.0, 23.1, 20.7)
"""fx, fy, cx, cy in pixels; the first pixel's centre is at 0.5."""
COUNT = 12
NAMES = [f"{index:03d}.png" for index in range(COUNT)]
HELD_OUT = [NAMES[0], NAMES[8]]
"""Every eighth by name."""
WAVES = np.array([[19.0, 3.0, 5.0], [4.0, 17.0, -6.0], [-5.0, 7.0, 18.0]])
"""Waves of the pattern: radians a metre, for each channel."""


COEFFICIENTS = ("k1", "k2", "k3", "k4", "k5", "k6", "k7", "p1", "p2")


@dataclass(frozen=True)
class Lens:
    """How places on the plane z = 1 are bent, as OpenCV defines it."""

    model: str = "pinhole"
    """pinhole, opencv or fisheye."""
    named: dict[str, float] = field(default_factory=dict)
    """k1 to k7 and p1, p2, with k7 for the numerator's r^8; the others are 0."""
    intrinsics: tuple[float, float, float, float] = INTRINSICS

    def bend(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """OpenCV's formulas, written out."""
        k1, k2, k3, k4, k5, k6, k7, p1, p2 = (self.named.get(name, 0.0) for name in COEFFICIENTS)
        r2 = x * x + y * y
        if self.model == "fisheye":
            r = np.sqrt(r2)
            theta = np.arctan(r)
            bent = theta * (1 + k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8)
            scale = np.where(r > 1e-12, bent / np.maximum(r, 1e-12), 1.0)
            return x * scale, y * scale
        radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3 + k7 * r2**4) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
        u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        return u, v

    def straighten(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The inverse: of a fisheye's angle by bisection, else by fixed-point iteration."""
        if self.model == "fisheye":
            k1, k2, k3, k4 = (self.named.get(name, 0.0) for name in COEFFICIENTS[:4])
            bent, low, high = np.hypot(u, v), np.zeros_like(u), np.full_like(u, 1.5)
            for _ in range(60):
                theta = (low + high) / 2
                short = theta * (1 + k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8) < bent
                low, high = np.where(short, theta, low), np.where(short, high, theta)
            scale = np.tan(low) / np.maximum(bent, 1e-12)
            return u * scale, v * scale
        x, y = u.copy(), v.copy()
        for _ in range(200):
            bent_u, bent_v = self.bend(x, y)
            x, y = x + 0.7 * (u - bent_u), y + 0.7 * (v - bent_v)
        return x, y

    @cached_property
    def local(self) -> np.ndarray:
        """(HEIGHT * WIDTH, 3) unit directions of the pixels in the camera's frame, OpenGL axes."""
        fx, fy, cx, cy = self.intrinsics
        rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
        x, y = self.straighten((columns.reshape(-1) - cx) / fx, (rows.reshape(-1) - cy) / fy)
        directions = np.stack([x, -y, -np.ones_like(x)], -1)
        return directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def pose_of(index: int) -> np.ndarray:
    """(4, 4) camera-to-world, OpenGL axes: around the ball, at several heights, looking nearly at it; z is up."""
    angle, height = 2 * math.pi * index / COUNT, 0.5 * math.sin(2.3 * index)
    away = np.array([math.cos(angle), math.sin(angle), height])
    position = CENTRE + (2.0 + 0.2 * math.cos(index)) * away / np.linalg.norm(away)
    back = position - CENTRE - np.array([0.05, -0.04, 0.06])
    back /= np.linalg.norm(back)
    right = np.cross([0.1, 0.05, 1.0], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(back, right), back, position], axis=1)
    return pose


def opencv_pose(index: int) -> np.ndarray:
    """(3, 4) world-to-camera with OpenCV's axes."""
    camera_to_world = pose_of(index) @ np.diag([1.0, -1, -1, 1])
    return np.linalg.inv(camera_to_world)[:3]


def met(origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Colours (R, 3) in [0, 1], distances (R,) and margins (R,) of rays (R, 3) with unit directions.

    The margin is positive, in squared radii, if a ray meets the ball; otherwise the other values mean nothing.
    """
    towards = CENTRE - origins
    along = (towards * directions).sum(-1)
    margins = 1 - ((towards**2).sum(-1) - along**2) / RADIUS**2
    distances = along - RADIUS * np.sqrt(np.clip(margins, 0, None))
    points = origins + distances[:, None] * directions
    return 0.5 + 0.45 * np.sin((points - CENTRE) @ WAVES.T), distances, margins


def looks(pose: np.ndarray, lens: Lens) -> np.ndarray:
    """(HEIGHT * WIDTH, 3) unit directions of a camera's pixels."""
    return lens.local @ pose[:3, :3].T


PINHOLE = Lens()


def photograph(index: int, lens: Lens = PINHOLE) -> np.ndarray:
    """(HEIGHT, WIDTH, 4) uint8: the ball, and nothing around it. Transparent pixels have a misleading colour."""
    pose = pose_of(index)
    directions = looks(pose, lens)
    colors, _, margins = met(np.broadcast_to(pose[:3, 3], directions.shape), directions)
    rgba = np.concatenate([colors, margins[:, None] > 0], -1)
    rgba[margins <= 0, :3] = (1.0, 0.0, 0.5)
    return (rgba * 255).round().astype(np.uint8).reshape(HEIGHT, WIDTH, 4)


def depth(index: int, lens: Lens = PINHOLE) -> np.ndarray:
    """(HEIGHT, WIDTH) metres along the camera's axis to the ball; 0 beside it."""
    pose = pose_of(index)
    directions = looks(pose, lens)
    _, distances, margins = met(np.broadcast_to(pose[:3, 3], directions.shape), directions)
    return np.where(margins > 0, distances * -(directions @ pose[:3, 2]), 0).reshape(HEIGHT, WIDTH)


def write_photographs(folder: Path, names: list[str], lens: Lens = PINHOLE) -> None:
    """Write the photographs from all places, under these names."""
    folder.mkdir(parents=True, exist_ok=True)
    for index, name in enumerate(names):
        Image.fromarray(photograph(index, lens)).save(folder / name)


def write_depths(folder: Path, names: list[str], lens: Lens = PINHOLE, steps: float = 1000.0) -> None:
    """16-bit pictures of depth, with a number of steps per metre."""
    folder.mkdir(parents=True, exist_ok=True)
    for index, name in enumerate(names):
        Image.fromarray((depth(index, lens) * steps).round().astype(np.uint16)).save(folder / name)


def surface(count: int = 40) -> np.ndarray:
    """(count, 3) points on the ball."""
    normals = np.random.default_rng(0).normal(size=(count, 3))
    return CENTRE + RADIUS * normals / np.linalg.norm(normals, axis=-1, keepdims=True)
