"""LLFF scenes: poses and depth bounds in poses_bounds.npy, beside the photographs (Mildenhall et al. 2019)."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dataparsers.captured import ENDINGS, REDUCED, Captured, Photographs, captured_scene, checked_box, has_transforms
from dataparsers.colmap_model import find_models
from dataparsers.masks import find_masks
from framework import DataError, ParsedScene
from framework.base.arrays import read_array
from framework.cameras.cameras import check_pose
from framework.cameras.ndc import NdcCameras, find_ndc, ndc_box
from framework.cameras.poses import Placement
from framework.data.dataset import Split, one_line

POSES = "poses_bounds.npy"
BOUNDS = f"the depth bounds of {POSES}"
NEAR_SHARE = 0.9
"""Rays start at this share of the smallest depth: of the points it was taken from, a few were nearer."""
FORWARD = 0.7
"""Least cosine between a viewing direction and the mean of all in a scene that is seen from one side (45 degrees)."""


@dataclass(frozen=True)
class Llff(Captured):
    """Flags of the llff format."""

    images_path: str = "images"
    """Where the photographs are, below the data folder; reduced ones are beside it, as in images_8."""
    masks_path: str = "masks"
    """Where masks are, below the data folder: white where a photograph is to be learnt from."""
    use_bounds: bool = True
    """Take from the file's depth bounds where rays start, unless `near` is farther, and of a scene that is seen from
    one side the box: all that lies between the bounds, times `scene_scale`."""
    ndc: bool = False
    """Learn in normalised device coordinates, for scenes that are seen from one side: all out to infinity is in the
    box, and near, far and scene_scale count for nothing. Depths are then such coordinates' too."""

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        return (path / POSES).is_file() and not find_models(path) and not has_transforms(path)

    def parse(self, path: Path | None, split: Split) -> ParsedScene:
        if path is None:
            raise DataError("the llff format needs a folder: --data DIR")
        names = _image_names(path / self.images_path)
        poses, intrinsics, sizes, bounds = read_poses_bounds(path / POSES, len(names))
        photographs = Photographs(
            folder=path,
            paths=tuple(path / self.images_path / name for name in names),
            names=tuple(names),
            poses=poses,
            intrinsics=intrinsics,
            sizes=sizes,
            masks=find_masks(path / self.masks_path, names),
        )
        scene = captured_scene(self, photographs, split)
        placed = Placement(_transform(scene).double(), scene.scale).poses(poses)
        corners, bounds = corner_directions(placed, intrinsics, sizes), bounds * scene.scale
        if self.ndc:
            return _in_ndc(scene, placed, corners, NEAR_SHARE * bounds[:, 0])
        return self._bounded(scene, placed, corners, bounds) if self.use_bounds else scene

    def _bounded(self, scene: ParsedScene, poses: Tensor, corners: Tensor, bounds: Tensor) -> ParsedScene:
        """A scene whose near, and whose box if it is seen from one side, are those of the file.

        Args:
            poses: (M, 3, 4) of all photographs, scene coordinates.
            corners: (M, 4, 3) as `corner_directions` gives them.
            bounds: (M, 2) scene units.
        """
        near = max(self.near or 0.0, NEAR_SHARE * float(bounds[:, 0].min()))
        if near >= self.far:
            raise DataError(
                f"--far {self.far} is nearer than what {POSES} says to be near; raise it, or --use-bounds False"
            )
        scene = replace(scene, near=near)
        if not faces_forward(poses):
            return scene
        ends = poses[:, None, None, :, 3] + bounds[:, :, None, None] * corners[:, None]
        box = torch.stack([ends.amin((0, 1, 2)), ends.amax((0, 1, 2))]).float()
        centre = box.mean(0)
        return replace(scene, box=checked_box(centre + (box - centre) * self.scene_scale, BOUNDS))


def read_poses_bounds(file: Path, count: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Read poses_bounds.npy: M rows of a 3x5 matrix [down, right, back, position, (height, width, focal)], near, far.

    Args:
        count: how many images there are.
    Returns: (M, 4, 4) float64 camera-to-world, OpenGL axes; (M, 4) fx, fy, cx, cy; (M, 2) int64 width and height that
        those are for; (M, 2) least and greatest depth, the input's units.
    Raises: DataError where the file is missing, damaged, or of another number of images.
    """
    try:
        table = read_array(file)
    except OSError as error:
        raise DataError(f"cannot read {file}: {error.strerror or one_line(error)}") from error
    except Exception as error:  # numpy raises ValueError, EOFError, SyntaxError, OverflowError and more
        raise DataError(f"{file} is not an array of numpy: {one_line(error)}") from error
    if table.ndim != 2 or table.shape[1] != 17 or table.dtype.kind not in "fiu":
        raise DataError(f"{file} holds an array of shape {table.shape}; it must be numbers of shape (images, 17)")
    if len(table) != count:
        raise DataError(
            f"{file} has poses of {len(table)} images, but there are {count}: which is whose cannot be told; "
            "remove the images without a pose"
        )
    values = torch.from_numpy(table.astype(np.float64))
    bounds = values[:, 15:]
    matrices = values[:, :15].view(-1, 3, 5)
    down, right, back, position, camera = matrices.unbind(-1)
    poses = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    poses[:, :3] = torch.stack([right, -down, back, position], dim=-1)
    for row in range(count):
        check_pose(poses[row], f"{file}: row {row}")
        height, width, focal = camera[row].tolist()
        if not (1 <= height < 1e6 and 1 <= width < 1e6 and 0 < focal < 1e9):
            raise DataError(f"{file}: row {row}: height, width and focal length are {height}, {width} and {focal}")
        near, far = bounds[row].tolist()
        if not 0 < near < far < float("inf"):
            raise DataError(
                f"{file}: row {row}: the depth bounds are {near} and {far}; they must be rising and positive"
            )
    height, width, focal = camera.unbind(-1)
    intrinsics = torch.stack([focal, focal, width / 2, height / 2], dim=-1)
    return poses, intrinsics, torch.stack([width, height], dim=-1).round().long(), bounds


def faces_forward(poses: Tensor) -> bool:
    """Whether cameras (M, 3, 4) look the same way, more or less."""
    back = poses[:, :, 2]
    mean = back.mean(0)
    return bool(((back @ mean) >= FORWARD * mean.norm()).all()) and bool(mean.norm() > 0)


def corner_directions(poses: Tensor, intrinsics: Tensor, sizes: Tensor) -> Tensor:
    """(M, 4, 3) directions through the corners of M pinhole cameras' images, 1 long along their axes.

    Args:
        poses: (M, 3, 4) camera-to-world.
        intrinsics: (M, 4) fx, fy, cx, cy in pixels.
        sizes: (M, 2) width and height in pixels.
    """
    sides = torch.tensor([[0, 0], [1, 0], [0, 1], [1, 1]])
    x, y = ((sides * sizes[:, None] - intrinsics[:, None, 2:]) / intrinsics[:, None, :2]).unbind(-1)
    return torch.stack([x, -y, -torch.ones_like(x)], dim=-1) @ poses[:, :, :3].transpose(1, 2)


def _in_ndc(scene: ParsedScene, poses: Tensor, corners: Tensor, nears: Tensor) -> ParsedScene:
    """A scene in normalised device coordinates: all that is seen is in its box, so nothing is outside."""
    ndc = find_ndc(poses, corners, nears)
    box = checked_box(ndc_box(ndc, poses, corners).float(), BOUNDS)
    cameras = NdcCameras(**{f.name: getattr(scene.cameras, f.name) for f in fields(scene.cameras)}, ndc=ndc)
    # No ray is longer than the box's diagonal.
    return replace(scene, cameras=cameras, box=box, near=0.0, far=float((box[1] - box[0]).norm()), unbounded=False)


def _transform(scene: ParsedScene) -> Tensor:
    return torch.eye(4)[:3] if scene.transform is None else scene.transform


def _image_names(root: Path) -> list[str]:
    """The images in a folder by sorted name, or where that has none, in the first of the reduced ones beside it.

    Raises: DataError where there is none.
    """
    folders = [root if step == 1 else root.with_name(f"{root.name}_{step}") for step in REDUCED]
    for folder in folders:
        names = sorted(file.name for file in folder.glob("*") if file.suffix in ENDINGS)
        if names:
            return names
    raise DataError(f"{root.parent} has no images: none is in {', '.join(folder.name for folder in folders)}")
