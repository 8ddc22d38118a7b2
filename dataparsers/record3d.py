"""Record3D's exports of an iPhone's or iPad's recordings: EXR_RGBD/metadata.json and EXR_RGBD/rgb/N.jpg."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from dataparsers.captured import Captured, Photographs, captured_scene, has_transforms
from dataparsers.reading import numbers, read_json, side
from framework import DataError, ParsedScene
from framework.data.dataset import Split, existing
from framework.data.scene import PoseSource
from framework.kernels.math import cross_matrix

METADATA, EXPORT = "metadata.json", "EXR_RGBD"
NORM_TOLERANCE = 0.01
"""How far from 1 the length of a rotation's quaternion may be."""


@dataclass(frozen=True)
class Record3D(Captured):
    """Flags of the record3d format."""

    poses: PoseSource = "device"
    max_images: int = 300
    """Take no more images than these, evenly spread over the recording; 0 takes all."""

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        folder = _folder(path)
        return (folder / METADATA).is_file() and (folder / "rgb").is_dir() and not has_transforms(path)

    def parse(self, path: Path | None, split: Split) -> ParsedScene:
        if path is None:
            raise DataError("the record3d format needs a folder: --data DIR")
        if self.max_images < 0:
            raise DataError(f"--max-images is {self.max_images}; it must be a whole number from 0")
        folder = _folder(path)
        file = folder / METADATA
        content = read_json(file)
        poses = _poses(content, file)
        paths = [_image(folder / "rgb", index) for index in range(len(poses))]
        keep = _spread(existing(paths, split), self.max_images)
        width, height = (side(content.get(key), key, str(file)) for key in "wh")
        photographs = Photographs(
            folder=folder,
            paths=tuple(paths),
            names=tuple(f"{index:09d}" for index in range(len(paths))),  # digits of one length sort as numbers do
            poses=poses,
            intrinsics=_intrinsics(content, file).expand(len(paths), 4),
            sizes=torch.tensor([[width, height]]).expand(len(paths), 2),
        )
        return captured_scene(self, photographs[keep], split)


def _folder(path: Path) -> Path:
    """The folder of the export, which may be the one that the user named or in it."""
    return path / EXPORT if (path / EXPORT).is_dir() else path


def _image(folder: Path, index: int) -> Path:
    """The image of a pose: its file's name is its number."""
    png = folder / f"{index}.png"
    return png if png.is_file() else folder / f"{index}.jpg"


def _spread(indices: Tensor, most: int) -> Tensor:
    """At most so many of some indices, evenly spread, with the first and the last; all for 0."""
    if most == 0 or len(indices) <= most:
        return indices
    return indices[torch.linspace(0, len(indices) - 1, most, dtype=torch.float64).round().long()]


def _poses(content: dict[str, Any], file: Path) -> Tensor:
    """(M, 3, 4) camera-to-world matrices of quaternions x, y, z, w and positions."""
    listed = content.get("poses")
    if not isinstance(listed, list) or not listed:
        raise DataError(f"{file}: 'poses' must list the camera's poses, and does not")
    values = [numbers(pose, 7, "poses", f"{file}: pose {index}") for index, pose in enumerate(listed)]
    table = torch.tensor(values, dtype=torch.float64)
    norms = table[:, :4].norm(dim=-1)
    off = (norms - 1).abs()
    if bool((off > NORM_TOLERANCE).any()):
        index = int(off.argmax())
        raise DataError(f"{file}: pose {index} has a quaternion of length {norms[index]:.3g}; a rotation's is 1")
    return torch.cat([rotations(table[:, :4] / norms[:, None]), table[:, 4:, None]], dim=-1)


def rotations(quaternions: Tensor) -> Tensor:
    """(M, 3, 3) rotation matrices of unit quaternions (M, 4) x, y, z, w."""
    vector, scalar = quaternions[:, :3], quaternions[:, 3]
    cross = cross_matrix(vector)
    # Rodrigues' formula in half angles: v -> v + 2 w (u x v) + 2 u x (u x v).
    return torch.eye(3, dtype=quaternions.dtype) + 2 * (scalar[:, None, None] * cross + cross @ cross)


def _intrinsics(content: dict[str, Any], file: Path) -> Tensor:
    """(4,) fx, fy, cx, cy of the matrix K, which is written column by column."""
    k = torch.tensor(numbers(content.get("K"), 9, "K", str(file)), dtype=torch.float64).view(3, 3).T
    if not bool((k.diagonal() > 0).all()) or not bool(k[2].eq(torch.tensor([0.0, 0.0, 1.0])).all()):
        raise DataError(f"{file}: 'K' is {k.T.flatten().tolist()}; it must be a camera's matrix, column by column")
    return torch.stack([k[0, 0], k[1, 1], k[0, 2], k[1, 2]])
