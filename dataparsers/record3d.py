"""Record3D's exports of recordings by an iPhone or iPad: EXR_RGBD/metadata.json and EXR_RGBD/rgb/N.jpg."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from nerfloom import DataError, ParsedScene
from nerfloom.base.evenly_spaced import evenly_spread
from nerfloom.base.json_files import read_object
from nerfloom.base.splits import Split
from nerfloom.data.dataset import existing_files
from nerfloom.data.names_on_disk import on_disk
from nerfloom.data.scene import PoseSource
from nerfloom.dataparsers.captured import captured_scene, has_transforms
from nerfloom.dataparsers.posed_images import Captured, PosedImages
from nerfloom.dataparsers.reading import numbers, side
from nerfloom.dataparsers.rotations import rotations, unit_quaternions

METADATA = "metadata.json"
"""File of poses and intrinsics."""
EXPORT = "EXR_RGBD"
"""Folder of an export."""


@dataclass(frozen=True)
class Record3D(Captured):
    """Flags of the record3d format."""

    poses: PoseSource = "device"
    max_images: int = 300
    """Maximum number of images, evenly spaced over the recording; 0 uses all."""

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        folder = _folder(path)
        return (folder / METADATA).is_file() and (folder / "rgb").is_dir() and not has_transforms(path)

    def parse(self, path: Path | None, split: Split) -> ParsedScene:
        if path is None:
            raise DataError("the record3d format needs a folder: --data DIR")
        if self.max_images < 0:
            raise DataError(f"--max-images is {self.max_images}; it must be an integer of at least 0")
        folder = _folder(path)
        file = folder / METADATA
        content = read_object(file)
        poses = _poses(content, file)
        paths = on_disk(folder, [f"rgb/{index}" for index in range(len(poses))], quiet=split != "train")
        existing = existing_files(paths, split)
        keep = existing[evenly_spread(len(existing), self.max_images or len(existing))]
        width, height = (side(content.get(key), key, str(file)) for key in "wh")
        images = PosedImages(
            folder=folder,
            paths=paths,
            names=tuple(f"{index:09d}" for index in range(len(paths))),  # padded, so that names sort by number
            poses=poses,
            intrinsics=_intrinsics(content, file).expand(len(paths), 4),
            sizes=torch.tensor([[width, height]]).expand(len(paths), 2),
        )
        return captured_scene(self, images[keep], split)


def _folder(path: Path) -> Path:
    """Return the folder of the export: the user's folder, or a folder in it."""
    return path / EXPORT if (path / EXPORT).is_dir() else path


def _poses(content: dict[str, Any], file: Path) -> Tensor:
    """Return camera-to-world matrices (M, 3, 4) from quaternions x, y, z, w and positions."""
    listed = content.get("poses")
    if not isinstance(listed, list) or not listed:
        raise DataError(f"{file}: 'poses' must be a list of camera poses")
    values = [numbers(pose, 7, "poses", f"{file}: pose {index}") for index, pose in enumerate(listed)]
    table = torch.tensor(values, dtype=torch.float64)
    unit = unit_quaternions(table[:, :4], [f"{file}: pose {index}" for index in range(len(table))])
    return torch.cat([rotations(unit), table[:, 4:, None]], dim=-1)


def _intrinsics(content: dict[str, Any], file: Path) -> Tensor:
    """Return fx, fy, cx, cy (4,) from the matrix K, which is stored column by column."""
    k = torch.tensor(numbers(content.get("K"), 9, "K", str(file)), dtype=torch.float64).view(3, 3).T
    if not bool((k.diagonal() > 0).all()) or not bool(k[2].eq(torch.tensor([0.0, 0.0, 1.0])).all()):
        raise DataError(f"{file}: 'K' is {k.T.flatten().tolist()}; it must be an intrinsic matrix, column by column")
    return torch.stack([k[0, 0], k[1, 1], k[0, 2], k[1, 2]])
