"""Captured scenes for the tests of their formats, and conditions for their cameras. Written without our own maths."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import torch

from nerfloom import ParsedScene

SIZE = (60, 40)
"""Width and height of the photographs that the cameras were fitted to."""


@dataclass
class Capture:
    """M photographs of K points: world-to-camera as OpenCV has it (y down, looking along +z)."""

    names: list[str]
    rotations: np.ndarray
    """(M, 3, 3)"""
    translations: np.ndarray
    """(M, 3)"""
    points: np.ndarray
    """(K, 3)"""

    def seen(self, image: int) -> np.ndarray:
        """(K, 2) places on the plane z = 1 in front of the camera."""
        local = self.points @ self.rotations[image].T + self.translations[image]
        assert (local[:, 2] > 0).all()
        return local[:, :2] / local[:, 2:]


def make_capture(count: int = 10, seed: int = 0, spread: float = 2.0) -> Capture:
    """Cameras on a ring of radius 4, more or less, that look at points near the origin; world y is down."""
    random = np.random.default_rng(seed)
    rotations, translations = [], []
    for index in range(count):
        angle = spread * np.pi * index / count
        position = np.array([4 * np.cos(angle), -1 + random.normal() * 0.3, 4 * np.sin(angle)])
        forward = random.normal(size=3) * 0.1 - position
        forward /= np.linalg.norm(forward)
        right = np.cross([0, 1.0, 0], forward)
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        rotations.append(rotation)
        translations.append(-rotation @ position)
    names = [f"p{index:02d}.png" for index in range(count)]
    return Capture(names, np.stack(rotations), np.stack(translations), random.uniform(-0.7, 0.7, (30, 3)))


def write_images(folder: Path, names: list[str], size: tuple[int, int] = SIZE) -> None:
    for index, name in enumerate(names):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        iio.imwrite(folder / name, np.full((size[1], size[0], 3), 20 + index, dtype=np.uint8))


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """w, x, y, z: the eigenvector that Bar-Itzhack (2000) gives."""
    r = rotation
    k = np.array(
        [
            [r[0, 0] - r[1, 1] - r[2, 2], 0, 0, 0],
            [r[1, 0] + r[0, 1], r[1, 1] - r[0, 0] - r[2, 2], 0, 0],
            [r[2, 0] + r[0, 2], r[2, 1] + r[1, 2], r[2, 2] - r[0, 0] - r[1, 1], 0],
            [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], r[0, 0] + r[1, 1] + r[2, 2]],
        ]
    )
    x, y, z, w = np.linalg.eigh(k)[1][:, -1]
    return np.array([w, x, y, z])


def write_colmap(
    folder: Path,
    capture: Capture,
    camera: str = "PINHOLE 60 40 50 48 31 19",
    tracks: int = 3,
    error: float = 0.5,
    seen_by: Sequence[int] | None = None,
) -> Path:
    """A text model with ids that are neither contiguous nor in the order of the names, a camera an image.

    Every point is seen by the first `tracks` images, or by the images in `seen_by`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    images = list(range(len(capture.names)))
    seeing = images[:tracks] if seen_by is None else list(seen_by)
    cameras = "".join(f"{3 * i + 5} {camera}\n" for i in images)
    (folder / "cameras.txt").write_text("# Camera list\n" + cameras)
    lines = ["# Image list"]
    for i in reversed(images):
        numbers = [*quaternion(capture.rotations[i]), *capture.translations[i]]
        lines.append(" ".join([str(100 - 2 * i), *map(repr, map(float, numbers)), str(3 * i + 5), capture.names[i]]))
        seen = [f"1.5 2.5 {7 * k + 1}" if i in seeing else "1.5 2.5 -1" for k in range(len(capture.points))]
        lines.append(" ".join(seen))
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    observations = " ".join(f"{100 - 2 * i} %d" for i in seeing)
    lines = ["# 3D point list"]
    for k, (x, y, z) in enumerate(capture.points.tolist()):
        lines.append(f"{7 * k + 1} {x!r} {y!r} {z!r} 9 9 9 {error} {observations.replace('%d', str(k))}")
    (folder / "points3D.txt").write_text("\n".join(lines) + "\n")
    return folder


def misses(scene: ParsedScene, image: int, columns: np.ndarray, rows: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(K,) by how many pixels rays through places on an image miss the points seen there.

    Args:
        columns, rows: (K,) pixels from the left and top edge; the centre of the first pixel is at 0.5.
        points: (K, 3) in the input's frame.
    """
    assert scene.transform is not None
    transform = scene.transform.double().numpy()
    placed = scene.scale * (points @ transform[:, :3].T + transform[:, 3])
    indices = torch.full((len(points),), image)
    at = [torch.from_numpy(values).float() - 0.5 for values in (columns, rows)]
    rays = scene.cameras.rays(indices, at[0], at[1], 0.1, 10.0)
    offsets = placed - rays.origins.double().numpy()
    directions = rays.directions.double().numpy()
    along = (offsets * directions).sum(-1)
    assert (along > 0).all()
    beside = np.linalg.norm(offsets - along[:, None] * directions, axis=-1)
    return beside / along * float(scene.cameras.fx[image])
