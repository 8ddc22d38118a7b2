"""Scenes of sdfstudio: meta_data.json with cameras, region of interest, and the transform to the original frame.

Yu et al. 2022. Monocular depths and normals, image pairs and lists of sparse points that it may name are not read.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import torch
from torch import Tensor

from nerfloom import DataError, ParsedScene
from nerfloom.base.errors import shown
from nerfloom.base.json_files import read_object
from nerfloom.base.splits import Split
from nerfloom.cameras.poses import Orientation
from nerfloom.data.depths import DEPTH_SUFFIXES
from nerfloom.data.names_on_disk import on_disk
from nerfloom.data.scene import PoseSource
from nerfloom.data.suffixes import IMAGE_SUFFIXES
from nerfloom.dataparsers.captured import MAX_MAGNITUDE, captured_scene, has_transforms, image_sizes, sizes_of
from nerfloom.dataparsers.companions import companions
from nerfloom.dataparsers.placing import Applied, from_original
from nerfloom.dataparsers.posed_images import Captured, PosedImages, StatedRegion
from nerfloom.dataparsers.projections import check_skew
from nerfloom.dataparsers.reading import file_name, numbers, read_frames, rigid, side_or_none

META = "meta_data.json"
"""File that identifies the format."""
MASKS = ("foreground_mask", "mask_path")
"""Entries that may name the mask of a frame."""
DEPTHS = "sensor_depth_path"
"""Entry that may name the measured depths of a frame, in the file's units."""


@dataclass(frozen=True)
class SdfStudio(Captured):
    """Flags of the sdfstudio format."""

    orientation_method: Orientation = "none"
    poses: PoseSource = "exact"

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        return (path / META).is_file() and not has_transforms(path)

    def parse(self, path: Path | None, split: Split) -> ParsedScene:
        if path is None:
            raise DataError("the sdfstudio format needs a folder: --data DIR")
        file = path / META
        content = read_object(file)
        applied = _from_gt(content, file)
        scene = captured_scene(self, _posed_images(file, content, split), split, applied=applied)
        return replace(from_original(scene, *applied), depth_unit=1 / applied[1])


def _posed_images(file: Path, content: dict[str, Any], split: Split) -> PosedImages:
    frames = read_frames(content, file, "rgb_path")
    if content.get("camera_model", "OPENCV") not in ("OPENCV", "PINHOLE"):
        raise DataError(f"{file}: 'camera_model' is {shown(content['camera_model'])}; it must be OPENCV")
    names = [file_name(frame.get("rgb_path"), "rgb_path", label) for frame, label in frames]
    paths = on_disk(file.parent, names, quiet=split != "train")
    stated = [side_or_none(content.get(key), key, str(file)) for key in ("width", "height")]
    sizes = sizes_of([stated] * len(frames), lambda: image_sizes(paths))
    matrices = torch.tensor([_intrinsics(*pair) for pair in frames], dtype=torch.float64)
    (fx, skews, cx), (fy, cy) = matrices[:, 0].unbind(-1), matrices[:, 1, 1:].unbind(-1)
    intrinsics = torch.stack([fx, fy, cx, cy], -1)
    check_skew(skews, intrinsics, sizes, [label for _, label in frames], quiet=split != "train")
    key = next((key for key in MASKS if any(frame.get(key) is not None for frame, _ in frames)), MASKS[0])
    axes = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))  # from OpenGL's to OpenCV's
    return PosedImages(
        folder=file.parent,
        paths=paths,
        names=tuple(str(PurePosixPath(name)) for name in names),
        poses=torch.stack([rigid(f.get("camtoworld"), f"{where}: 'camtoworld'", where) @ axes for f, where in frames]),
        intrinsics=intrinsics,
        sizes=sizes,
        masks=companions(file.parent, frames, key, IMAGE_SUFFIXES, split),
        depths=companions(file.parent, frames, DEPTHS, DEPTH_SUFFIXES, split),
        region=_region(content, file),
    )


def _intrinsics(frame: dict[str, Any], label: str) -> list[list[float]]:
    """Return the upper two rows of a frame's intrinsic matrix, without a fourth column."""
    rows = frame.get("intrinsics")
    if not isinstance(rows, list) or len(rows) not in (3, 4) or not all(isinstance(row, list) for row in rows):
        raise DataError(f"{label}: 'intrinsics' is {shown(rows)}; it must be a 3x3 or 4x4 matrix")
    upper = [numbers(row, len(rows), "intrinsics", label)[:3] for row in rows[:2]]
    if not min(upper[0][0], upper[1][1]) > 0 or upper[1][0] != 0:
        raise DataError(f"{label}: 'intrinsics' begins with {upper}; focal lengths must be above zero")
    return upper


def _region(content: dict[str, Any], file: Path) -> StatedRegion | None:
    """Return the box of interest in the frame of the poses; None if the file states none."""
    box = content.get("scene_box")
    corners = box.get("aabb") if isinstance(box, dict) else None
    if corners is None:
        return None
    if not isinstance(corners, list) or len(corners) != 2:
        raise DataError(f"{file}: 'aabb' is {shown(corners)}; it must be two corners")
    low, high = torch.tensor([numbers(corner, 3, "aabb", str(file)) for corner in corners], dtype=torch.float64)
    center, half = (low + high) / 2, (high - low) / 2
    if not bool((half > 1 / MAX_MAGNITUDE).all()) or not bool((center.abs() + half < MAX_MAGNITUDE).all()):
        raise DataError(f"{file}: 'aabb' is {shown(corners)}; it must be the lower and the upper corner of a box")
    return StatedRegion(center, half, is_ball=False)


def _from_gt(content: dict[str, Any], file: Path) -> Applied:
    """Return the transform from the original frame to the file's, and the scale after it: the inverse of worldtogt."""
    rows = content.get("worldtogt")
    if rows is None:
        return torch.eye(4, dtype=torch.float64), 1.0
    if not isinstance(rows, list) or len(rows) not in (3, 4):
        raise DataError(f"{file}: 'worldtogt' is {shown(rows)}; it must be a 4x4 matrix")
    matrix = torch.tensor([numbers(row, 4, "worldtogt", str(file)) for row in rows[:3]], dtype=torch.float64)
    scale = float(matrix[:, :3].norm()) / math.sqrt(3)
    if not 1 / MAX_MAGNITUDE < scale < MAX_MAGNITUDE:
        raise DataError(f"{file}: 'worldtogt' scales by {scale:.3g}: out of range")
    name = f"{file}: 'worldtogt', divided by its scale"
    back: Tensor = torch.linalg.inv(rigid(torch.cat([matrix[:, :3] / scale, matrix[:, 3:]], -1).tolist(), name, name))
    return back, 1 / scale
