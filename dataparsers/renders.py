"""The renders listed in a transforms_{split}.json: files, cameras, and other entries."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from nerfloom.base.json_files import read_object
from nerfloom.base.splits import Split
from nerfloom.data.dataset import existing_files
from nerfloom.data.image_files import image_size
from nerfloom.data.names_on_disk import on_disk
from nerfloom.dataparsers.intrinsics import ngp_cube, read_intrinsics
from nerfloom.dataparsers.posed_images import PosedImages
from nerfloom.dataparsers.reading import file_name, read_frames, read_pose, read_times

OF_LENSES = ("fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "p1", "p2", "camera_model", "is_fisheye")
"""Entries that describe a lens beyond its angle of view."""


@dataclass(frozen=True)
class Renders:
    """The images of one split that have a file."""

    images: PosedImages
    """M images."""
    cube: tuple[Tensor, float] | None
    """Centre (3,) float64 and edge of instant-ngp's cube, in the input's units; None if the file has none."""
    only_angle: bool
    """Whether the file states an angle of view and nothing else about lenses."""


def read_renders(folder: Path, split: Split, is_wanted: bool = True) -> Renders:
    """Read transforms_{split}.json.

    Args:
        folder: folder of the file.
        is_wanted: False if the images only determine the placement of others; problems are then not reported.

    Raises:
        DataError: if the file is missing or invalid, or none of its images exists.
    """
    file = folder / f"transforms_{split}.json"
    content = read_object(file)
    frames = read_frames(content, file, "file_path")
    names = [file_name(frame.get("file_path"), "file_path", label) for frame, label in frames]  # often without suffixes
    quiet = split != "train" or not is_wanted
    paths = on_disk(folder, names, quiet=quiet)
    poses = torch.stack([read_pose(frame, label) for frame, label in frames])
    keep = existing_files(paths, split) if is_wanted else _existing(paths)
    size = image_size([paths[index] for index in keep.tolist()])
    frames, plain = [(_without_sensor(frame), label) for frame, label in frames], _without_sensor(content)
    lenses = read_intrinsics(file, plain, frames, lambda: torch.tensor([size]).expand(len(paths), 2), quiet)
    images = PosedImages(
        folder=folder,
        paths=paths,
        names=tuple(path.name for path in paths),
        poses=poses,
        intrinsics=lenses.intrinsics,
        sizes=lenses.sizes,
        model=lenses.model,
        lens=lenses.lens,
        times=read_times(frames),
    )
    sources = content, *(frame for frame, _ in frames)
    only_angle = not any(source.get(name) is not None for source in sources for name in OF_LENSES)
    return Renders(images[keep], ngp_cube(content, file), only_angle)


def _existing(paths: Sequence[Path]) -> Tensor:
    return torch.tensor([index for index, path in enumerate(paths) if path.is_file()], dtype=torch.int64)


def _without_sensor(source: dict[str, Any]) -> dict[str, Any]:
    """Return entries without the vertical angle if the horizontal one is there.

    Blender's `angle_y` belongs to its sensor, 36 by 24 mm, not to the height of the image.
    """
    if source.get("camera_angle_x") is None:
        return source
    return {name: value for name, value in source.items() if name != "camera_angle_y"}
