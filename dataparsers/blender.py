"""NeRF-Synthetic scenes: transforms_{train,val,test}.json written by Blender, RGBA images (Mildenhall et al. 2020)."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from dataparsers.reading import file_name, read_json, read_pose, read_times, shown
from framework import Cameras, DataError, DataParser, ParsedScene
from framework.data.dataset import Split, existing_files, image_size
from framework.data.names_on_disk import on_disk

TRANSFORMS = "transforms_train.json"
"""File by which the format is recognised."""
SMALLEST_ANGLE = 1e-6
"""Minimum field of view, radians; for a smaller one the focal length exceeds the range of float32."""

MOST_SCALES = 8
"""Maximum number of sizes of an image; at the eighth, a pixel is the mean of 16,384."""


@dataclass(frozen=True)
class Blender(DataParser):
    """Flags of the blender format."""

    downscale_factor: int = 1
    """Integer factor by which images are reduced."""
    scale_factor: float = 1.0
    """Factor of camera positions, and thus of the scene."""
    half_size: float = 1.5
    """Half the side of the cube around the origin that holds the scene, in the input's units."""
    near: float = 2.0
    """Distance from a camera at which the scene starts, in the input's units."""
    far: float = 6.0
    """Distance from a camera at which the scene ends, in the input's units."""
    multiscale: int = 1
    """Number of sizes at which each image is used, 1, 1/2, 1/4, ..., with a loss weighted by the area of pixels; 4 is
    Mip-NeRF's multiscale protocol."""

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        file = path / TRANSFORMS
        return file.is_file() and not has_times(file)

    def parse(self, path: Path | None, split: Split) -> ParsedScene:
        if path is None:
            raise DataError("the blender format needs a folder: --data DIR")
        if self.downscale_factor < 1:
            raise DataError(f"--downscale-factor is {self.downscale_factor}; it must be an integer of at least 1")
        if not 1 <= self.multiscale <= MOST_SCALES:
            raise DataError(f"--multiscale is {self.multiscale}; it must be from 1 to {MOST_SCALES}")
        file = path / f"transforms_{split}.json"
        content = read_json(file)
        frames = content.get("frames")
        if not isinstance(frames, list) or not frames:
            raise DataError(f"{file} lists no frames")
        labels = [f"{file}: frame {index}" for index in range(len(frames))]
        names = [_image_name(frame, label) for frame, label in zip(frames, labels, strict=True)]
        paths = on_disk(path, names, quiet=split != "train")
        poses = torch.stack([read_pose(frame, label) for frame, label in zip(frames, labels, strict=True)])
        keep = existing_files(paths, split)
        width, height = image_size([paths[index] for index in keep.tolist()])
        scene = ParsedScene(
            image_paths=paths,
            cameras=self._cameras(poses, _focal_length(content, width, file), width, height),
            box=torch.tensor([[-1.0], [1.0]]).expand(2, 3) * self.half_size * self.scale_factor,
            near=self.near * self.scale_factor,
            far=self.far * self.scale_factor,
            times=read_times(frames, labels),
            scale=self.scale_factor,
            downscale_factor=self.downscale_factor,
            num_scales=self.multiscale,
        )
        return scene[keep]

    def _cameras(self, poses: Tensor, focal: float, width: int, height: int) -> Cameras:
        count = len(poses)
        poses = poses[:, :3].clone()
        poses[:, :, 3] *= self.scale_factor
        return Cameras(
            camera_to_worlds=poses,
            fx=torch.full((count,), focal),
            fy=torch.full((count,), focal),
            cx=torch.full((count,), width / 2),
            cy=torch.full((count,), height / 2),
            widths=torch.full((count,), width),
            heights=torch.full((count,), height),
        )


def has_times(file: Path) -> bool:
    """Return whether the first frame of the transforms file `file` has a time. Never raises."""
    try:
        frames = json.loads(file.read_text(encoding="utf-8")).get("frames")
        return isinstance(frames, list) and bool(frames) and isinstance(frames[0], dict) and "time" in frames[0]
    except (OSError, ValueError, RecursionError, AttributeError):
        return False


def _image_name(frame: Any, label: str) -> str:
    """Return the name of a frame's image; Blender writes names without a suffix."""
    return file_name(frame.get("file_path") if isinstance(frame, dict) else None, "file_path", label)


def _focal_length(content: dict[str, Any], width: int, file: Path) -> float:
    """Return the focal length in pixels, from the horizontal field of view."""
    angle = content.get("camera_angle_x")
    if not isinstance(angle, (int, float)) or isinstance(angle, bool) or not SMALLEST_ANGLE < angle < math.pi:
        raise DataError(f"{file}: 'camera_angle_x' is {shown(angle)}; it must be an angle between 0 and pi radians")
    return 0.5 * width / math.tan(0.5 * angle)
