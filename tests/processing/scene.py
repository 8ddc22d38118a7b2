"""Photographs of a corner of three textured planes, with exact poses, to compare found poses with."""

import math
from pathlib import Path

import numpy as np
from PIL import Image

WIDTH, HEIGHT, FOCAL = 320, 240, 300.0


def texture(seed: int, size: int = 1024) -> np.ndarray:
    """(size, size, 3) noise of many scales, uint8."""
    random = np.random.default_rng(seed)
    total = np.zeros((size, size, 3))
    for cells in (8, 16, 32, 64, 128, 256):
        noise = (random.random((cells, cells, 3)) * 255).astype(np.uint8)
        total += np.asarray(Image.fromarray(noise).resize((size, size), Image.Resampling.BICUBIC), float)
    total -= total.min()
    return (total / total.max() * 255).astype(np.uint8)


def pose_at(angle: float, height: float) -> np.ndarray:
    """(4, 4) camera-to-world, OpenGL axes: in front of the corner, looking at its inside."""
    centre = np.array([3.2 * math.cos(angle), 3.2 * math.sin(angle), height])
    back = centre - np.array([0.8, 0.8, 0.7])
    back /= np.linalg.norm(back)
    right = np.cross([0, 0, 1.0], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(back, right), back, centre], axis=1)
    return pose


def photograph(pose: np.ndarray, textures: list[np.ndarray], finer: int = 2) -> Image.Image:
    """A camera's image of the planes x = 0, y = 0, z = 0: the first of them that a ray meets."""
    rows, columns = (np.mgrid[: HEIGHT * finer, : WIDTH * finer] + 0.5) / finer
    local = np.stack([(columns - WIDTH / 2) / FOCAL, -(rows - HEIGHT / 2) / FOCAL, -np.ones_like(rows)], -1)
    directions, origin = local @ pose[:3, :3].T, pose[:3, 3]
    with np.errstate(divide="ignore"):
        distances = -origin / directions
    distances[distances <= 0] = np.inf
    nearest = distances.argmin(-1)
    points = origin + np.take_along_axis(distances, nearest[..., None], -1) * directions
    image = np.zeros((*rows.shape, 3), np.uint8)
    for axis in range(3):
        here = nearest == axis
        across = np.delete(points[here], axis, axis=1)
        texel = (np.clip(across / 5 + 0.2, 0, 0.9999) * len(textures[axis])).astype(int)
        image[here] = textures[axis][texel[:, 0], texel[:, 1]]
    return Image.fromarray(image).resize((WIDTH, HEIGHT), Image.Resampling.BOX)


def write_corner(folder: Path, count: int = 20) -> dict[str, np.ndarray]:
    """Photographs of the corner from an arc, as PNG; their poses by name."""
    folder.mkdir(parents=True)
    textures = [texture(seed) for seed in range(3)]
    poses = {}
    for index in range(count):
        share = index / (count - 1)
        pose = pose_at(0.25 + 1.05 * share, 1.2 + 0.5 * math.sin(7 * share))
        name = f"view {index}.PNG"
        photograph(pose, textures).save(folder / name, format="PNG")
        poses[name] = pose
    return poses
