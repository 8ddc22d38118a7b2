"""Many random scenes: balls and boxes of random size, position and colour, for methods that learn from several scenes.

A data set has training scenes and, in its other splits, scenes that are in no other split. Every fourth view of these
is evaluated; the others are source images.
"""

from __future__ import annotations

import colorsys
import json
import math
from functools import partial
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import torch
from torch import Tensor

from nerfloom.dataparsers.procedural.scene import Colour, Part, Parts
from nerfloom.dataparsers.procedural.shapes import Box, Shape, Sphere
from nerfloom.dataparsers.procedural.views import CAMERA_ANGLE, camera_poses, complete_folder, in_parallel, render_view

UNSEEN = {"val": 4, "test": 8}
"""Number of held-out scenes of each split."""
JUDGED_EVERY = 4
"""Distance between evaluated views of a held-out scene."""
MIN_SOLIDS, MAX_SOLIDS = 2, 5
"""Number of solids in a scene."""
MAX_REACH = 1.35
"""Maximum distance of solids from the origin, scene units."""


def random_parts(seed: int, scene: int) -> Parts:
    """Return the solids of scene `scene` of a data set with a `seed`; they are matte and may intersect."""
    random = np.random.default_rng([seed, scene])
    return {f"solid {index}": _random_part(random) for index in range(random.integers(MIN_SOLIDS, MAX_SOLIDS + 1))}


def _random_part(random: np.random.Generator) -> Part:
    size = random.uniform(0.0, 1.0)
    shape: Shape = Sphere(0.25 + 0.25 * size) if random.random() < 0.5 else Box((0.2 + 0.2 * size,) * 3)
    direction = random.normal(size=3)
    distance = (MAX_REACH - shape.bound) * random.uniform() ** (1 / 3)  # uniform in the ball where it fits
    x, y, z = (distance * direction / np.linalg.norm(direction)).tolist()
    colour = colorsys.hsv_to_rgb(random.uniform(), random.uniform(0.5, 1.0), random.uniform(0.3, 0.9))
    return Part(shape, (x, y, z), random.uniform(0.0, math.pi / 2), partial(_plain, colour), 0.0)


def _plain(colour: Colour, p: Tensor) -> Tensor:
    """Return the same albedo (3, R) at all points `p` (3, R)."""
    return p.new_tensor(colour)[:, None].expand_as(p)


def scene_numbers(split: str, num_scenes: int) -> range:
    """Return the indices of the scenes of a `split`, given `num_scenes` to train on; no scene is in two splits."""
    if split == "train":
        return range(num_scenes)
    first = num_scenes + (UNSEEN["val"] if split == "test" else 0)
    return range(first, first + UNSEEN[split])


def what_is_shown(paths: tuple[Path, ...], split: str) -> tuple[Tensor, Tensor | None]:
    """Return the scene of each image, and which images are sources that are not evaluated.

    Args:
        paths: M images written by `write_scenes`.
        split: their split.

    Returns:
        (M,) int64 indices of the scenes; and (M,) bool, or None for training scenes.
    """
    numbers = torch.tensor([[int(number) for number in path.stem.split("_")[1::2]] for path in paths])
    given = numbers[:, 1] % JUDGED_EVERY != JUDGED_EVERY - 1
    return numbers[:, 0], None if split == "train" else given


def write_scenes(
    folder: Path,
    *,
    size: int,
    num_scenes: int,
    views: int,
    seed: int = 0,
) -> None:
    """Write a data set of many scenes in NeRF-Synthetic's format, completely or not at all.

    Args:
        folder: folder to create. If another process creates it meanwhile, its content is kept.
        size: width and height of the images, pixels.
        num_scenes: number of training scenes.
        views: number of views of each scene.
        seed: seed of the scenes and the cameras. The same seed gives the same bytes.

    Raises:
        OSError: if the folder cannot be written.
    """
    with complete_folder(folder) as temporary:
        jobs = [
            (temporary / split, scene) for split in ("train", *UNSEEN) for scene in scene_numbers(split, num_scenes)
        ]
        written = in_parallel(partial(_write_scene, size=size, views=views, seed=seed), jobs, "Rendering many scenes")
        frames: dict[str, list[dict[str, Any]]] = {}
        for (place, _), of_scene in zip(jobs, written, strict=True):
            frames.setdefault(place.name, []).extend(of_scene)
        for split, of_split in frames.items():
            content = {"camera_angle_x": CAMERA_ANGLE, "frames": of_split}
            (temporary / f"transforms_{split}.json").write_text(json.dumps(content, indent=1), encoding="utf-8")


def _write_scene(folder: Path, scene: int, size: int, views: int, seed: int) -> list[dict[str, Any]]:
    """Write the images of a scene and return their entries for the JSON file."""
    folder.mkdir(parents=True, exist_ok=True)
    parts, frames = random_parts(seed, scene), []
    for index, pose in enumerate(camera_poses("train", views, seed * 1_000_003 + scene)):
        name = f"scene_{scene:04d}_view_{index:02d}"
        iio.imwrite(folder / f"{name}.png", render_view(pose, CAMERA_ANGLE, size, size, geometry=False, parts=parts)[0])
        frames.append({"file_path": f"./{folder.name}/{name}", "transform_matrix": pose.tolist()})
    return frames
