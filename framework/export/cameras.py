"""Export of the cameras of all splits in the frame and units of the input."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from nerfloom.base.errors import ConfigError
from nerfloom.base.splits import Split
from nerfloom.cameras.cameras import Cameras, join_cameras
from nerfloom.cameras.poses import Placement
from nerfloom.data.parsed_scene import ParsedScene
from nerfloom.geometry.alignment import nearest_rotations
from nerfloom.geometry.lenses import LENSES

SPLITS: tuple[Split, ...] = ("train", "val", "test")
"""Splits, in the order of their images in the file."""


def camera_list(cameras: Cameras, names: Sequence[str], placement: Placement) -> list[dict[str, Any]]:
    """Return `names` and M poses (3 x 4) of `cameras` in the input's frame by `placement`, in nerfstudio's format."""
    poses = input_poses(cameras, placement)
    return [{"file_path": name, "transform": pose} for name, pose in zip(names, poses.tolist(), strict=True)]


def input_poses(cameras: Cameras, placement: Placement) -> Tensor:
    """Return the M poses (3, 4) of `cameras` in the input's frame by `placement`, float64, rotations orthonormal."""
    poses = placement.original_poses(cameras.camera_to_worlds.cpu())
    return torch.cat([nearest_rotations(poses[:, :, :3]), poses[:, :, 3:]], -1)


@dataclass(frozen=True)
class PosedFiles:
    """M images of all splits with their cameras, each once."""

    files: tuple[Path, ...]
    """M image files."""
    poses: Tensor
    """(M, 3, 4) float64 camera-to-world, OpenGL axes, in the input's frame."""
    cameras: Cameras
    """M cameras in the scene's frame, for the sizes of the files."""
    splits: Mapping[str, tuple[int, ...]]
    """Split -> indices of its images."""
    masks: tuple[Path | None, ...]
    """M mask files; None for an image without."""
    times: Tensor | None
    """(M,) time of each image in [0, 1]; None for a static scene."""
    points: Tensor | None
    """(K, 3) float64 sparse points in the input's frame; None if there are none."""
    pixels_per_unit: float
    """Factor from pixels per scene unit to pixels per unit of the input, for orthographic cameras."""


def posed_files(scenes: Mapping[str, ParsedScene], placement: Placement) -> PosedFiles:
    """Return the images of all splits of `scenes` by their `placement`, each once, with its first camera."""
    files: dict[Path, int] = {}
    chosen: list[tuple[str, int]] = []
    splits: dict[str, tuple[int, ...]] = {}
    for split, scene in scenes.items():
        members = []
        for index, path in enumerate(scene.image_paths):
            if path not in files:
                files[path] = len(files)
                chosen.append((split, index))
            members.append(files[path])
        splits[split] = tuple(members)
    parts = {split: [index for owner, index in chosen if owner == split] for split in scenes}
    joined = join_cameras([scenes[split].cameras[torch.tensor(parts[split])] for split in scenes if parts[split]])
    moving = all(scene.times is not None for scene in scenes.values())
    points = next((scene.points for scene in scenes.values() if scene.points is not None), None)
    return PosedFiles(
        files=tuple(files),
        poses=input_poses(joined, placement),
        cameras=joined,
        splits=splits,
        masks=tuple(None if (masks := scenes[split].mask_paths) is None else masks[index] for split, index in chosen),
        times=torch.cat([_times(scenes[split])[parts[split]] for split in scenes]) if moving else None,
        points=None if points is None else placement.original_points(points),
        pixels_per_unit=placement.scale,
    )


def _times(scene: ParsedScene) -> Tensor:
    assert scene.times is not None
    return scene.times


def coefficients(cameras: Cameras) -> list[dict[str, float]]:
    """Return the distortion coefficients of M `cameras` by their names in `LENSES`."""
    names = LENSES[cameras.model]
    if cameras.lens is None:
        return [dict.fromkeys(names, 0.0)] * len(cameras)
    return [dict(zip(names, row, strict=True)) for row in cameras.lens.double().tolist()]


def rational(lenses: Sequence[Mapping[str, float]]) -> bool:
    """Return whether any of `lenses` has coefficients of the denominator, k4 to k6.

    Raises:
        ConfigError: if a lens also has k7, which no format can store.
    """
    found = any(lens.get(name) for lens in lenses for name in ("k4", "k5", "k6"))
    if found and any(lens.get("k7") for lens in lenses):
        raise ConfigError("the lens has both k4 to k6 of the denominator and the r^8 term, which no format can hold")
    return found
