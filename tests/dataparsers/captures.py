"""A capture with a known truth: points in front of cameras, and their positions in each image."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import torch

from nerfloom import Cameras, ParsedScene

FX, FY, CX, CY = 50.0, 52.0, 21.0, 14.0
WIDTH, HEIGHT = 40, 30
POINTS = np.array([[0.3, -0.2, 0.5], [-0.4, 0.1, 0.9], [0.0, 0.5, 0.2], [0.2, 0.3, 0.6]])
"""Between the cameras of `poses`, in the input's frame."""


def poses(count: int = 9, radius: float = 3.0) -> np.ndarray:
    """(count, 4, 4) camera-to-world: on part of a circle 1.5 above the points, looking at them; x right, z back."""
    found = []
    for angle in np.linspace(0.2, 4.0, count):
        position = np.array([radius * math.cos(angle), radius * math.sin(angle), 1.5])
        back = position - POINTS.mean(0)
        back /= np.linalg.norm(back)
        right = np.cross([0, 0, 1.0], back)
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3] = np.stack([right, np.cross(back, right), back, position], axis=1)
        found.append(pose)
    return np.stack(found)


def seen_at(pose: np.ndarray, point: np.ndarray) -> tuple[float, float]:
    """Column and row of a point of the input in a pinhole camera, with (0, 0) at the image's corner."""
    right, down, ahead = np.diag([1, -1, -1]) @ pose[:3, :3].T @ (point - pose[:3, 3])
    assert ahead > 0
    return CX + FX * right / ahead, CY + FY * down / ahead


def write_images(folder: Path, names: list[str], width: int = WIDTH, height: int = HEIGHT) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for index, name in enumerate(names):
        iio.imwrite(folder / name, np.full((height, width, 3), 20 * index % 256, dtype=np.uint8))


def edit(folder: Path, change: Callable[[dict[str, Any]], Any], file: str = "transforms.json") -> None:
    """Change a JSON file of a folder in place."""
    content = json.loads((folder / file).read_text())
    change(content)
    (folder / file).write_text(json.dumps(content))


def moved(given: np.ndarray, unit: float, shift: np.ndarray) -> np.ndarray:
    """The poses (M, 4, 4) in another unit and at another place: position x becomes unit * x + shift."""
    found = given.copy()
    found[:, :3, 3] = unit * found[:, :3, 3] + shift
    return found


def write_capture(folder: Path, count: int = 9, given: np.ndarray | None = None, **changes: Any) -> Path:
    """A nerfstudio folder, with `given` poses instead of `poses` if any; `changes` go into its file."""
    names = [f"{index:03d}.png" for index in range(count)]
    write_images(folder / "images", names)
    frames = [
        {"file_path": f"images/{name}", "transform_matrix": pose.tolist()}
        for name, pose in zip(names, poses(count) if given is None else given, strict=True)
    ]
    content = {"camera_model": "PINHOLE", "w": WIDTH, "h": HEIGHT, "fl_x": FX, "fl_y": FY, "cx": CX, "cy": CY}
    (folder / "transforms.json").write_text(json.dumps({**content, "frames": frames, **changes}))
    return folder


def to_scene(scene: ParsedScene, points: np.ndarray) -> torch.Tensor:
    """Points (K, 3) of the input in the scene, by the scene's own account."""
    assert scene.transform is not None
    transform = scene.transform.double()
    return scene.scale * (torch.from_numpy(points) @ transform[:, :3].T + transform[:, 3])


def miss(cameras: Cameras, camera: int, column: float, row: float, point: torch.Tensor) -> float:
    """How far from a point the ray passes that starts at a place of an image, relative to the distance."""
    index = torch.tensor([camera])
    rays = cameras.rays(index, torch.tensor([column - 0.5]), torch.tensor([row - 0.5]), 0.0, 1.0)
    away = point.double() - rays.origins[0].double()
    direction = rays.directions[0].double()
    assert torch.dot(away, direction) > 0
    return float((away - torch.dot(away, direction) * direction).norm() / away.norm())


def worst_miss(scene: ParsedScene, true_poses: np.ndarray, points: np.ndarray = POINTS) -> float:
    """Largest distance of a point from the ray of its pixel in the input, for cameras with images of any size.

    Args:
        true_poses: (M, 4, 4) of the scene's images, in the input's frame.
    """
    placed, worst = to_scene(scene, points), 0.0
    for camera, pose in enumerate(true_poses):
        stretch = scene.cameras.widths[camera].item() / WIDTH, scene.cameras.heights[camera].item() / HEIGHT
        for point, target in zip(points, placed, strict=True):
            column, row = seen_at(pose, point)
            worst = max(worst, miss(scene.cameras, camera, column * stretch[0], row * stretch[1], target))
    return worst
