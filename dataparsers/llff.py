"""LLFF scenes: poses and depth bounds in poses_bounds.npy, beside the images (Mildenhall et al. 2019)."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from nerfloom import DataError, ParsedScene
from nerfloom.base.arrays import read_array
from nerfloom.base.errors import one_line
from nerfloom.base.splits import Split
from nerfloom.cameras.cameras import check_pose
from nerfloom.cameras.ndc import NdcCameras, find_ndc, ndc_box
from nerfloom.data.names_on_disk import REDUCED, reduced_folder
from nerfloom.dataparsers.captured import captured_scene, checked_box, has_transforms
from nerfloom.dataparsers.colmap_model import find_models
from nerfloom.dataparsers.masks import find_masks
from nerfloom.dataparsers.numbered import image_names
from nerfloom.dataparsers.posed_images import Captured, PosedImages

POSES = "poses_bounds.npy"
"""File of poses and depth bounds."""
BOUNDS = f"the depth bounds of {POSES}"
"""Subject of error messages about the depth bounds."""
NEAR_SHARE = 0.9
"""Near distance as a fraction of the smallest depth bound. The bound is a percentile of depths; a few are smaller."""
MIN_FORWARD_COSINE = 0.7
"""Minimum cosine between a viewing direction and the mean direction in a forward-facing scene (45 degrees)."""


@dataclass(frozen=True)
class Llff(Captured):
    """Flags of the llff format."""

    images_path: str = "images"
    """Folder of the images in the data folder; reduced images are in folders beside it, such as images_8."""
    masks_path: str = "masks"
    """Folder of masks in the data folder: white for pixels to train on."""
    use_bounds: bool = True
    """Use the file's depth bounds. Rays start there, unless `near` is larger; the box of a forward-facing scene holds
    everything between the bounds, times `scene_scale`."""
    ndc: bool = False
    """Train in normalised device coordinates, for forward-facing scenes. The box holds everything up to infinity; near,
    far and scene_scale have no effect; depths are in these coordinates."""

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        return (path / POSES).is_file() and not find_models(path) and not has_transforms(path)

    def parse(self, path: Path | None, split: Split) -> ParsedScene:
        if path is None:
            raise DataError("the llff format needs a folder: --data DIR")
        names = _image_names(path / self.images_path)
        poses, intrinsics, sizes, bounds = read_poses_bounds(path / POSES, len(names))
        images = PosedImages(
            folder=path,
            paths=tuple(path / self.images_path / name for name in names),
            names=tuple(names),
            poses=poses,
            intrinsics=intrinsics,
            sizes=sizes,
            masks=find_masks(path / self.masks_path, names),
        )
        scene = captured_scene(self, images, split)
        placed = scene.placement.poses(poses)
        corners, bounds = corner_directions(placed, intrinsics, sizes), bounds * scene.scale
        if self.ndc:
            return _in_ndc(scene, placed, corners, NEAR_SHARE * bounds[:, 0])
        return self._bounded(scene, placed, corners, bounds) if self.use_bounds else scene

    def _bounded(self, scene: ParsedScene, poses: Tensor, corners: Tensor, bounds: Tensor) -> ParsedScene:
        """Return the scene with the file's near distance and, if it is forward-facing, the file's box.

        Args:
            scene: the scene as placed by the flags.
            poses: (M, 3, 4) camera-to-world of all images, scene coordinates.
            corners: (M, 4, 3), from `corner_directions`.
            bounds: (M, 2) smallest and largest depth, scene units.
        """
        near = max(self.near or 0.0, NEAR_SHARE * float(bounds[:, 0].min()))
        if near >= self.far:
            raise DataError(
                f"--far {self.far} is less than the near bound in {POSES}; raise it, or set --use-bounds False"
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
        file: the file.
        count: number of images M.

    Returns:
        Camera-to-world matrices (M, 4, 4) float64, OpenGL axes; fx, fy, cx, cy (M, 4); their width and height (M, 2)
        int64; smallest and largest depth (M, 2), in the input's units.

    Raises:
        DataError: if the file is missing, damaged, or has another number of images.
    """
    try:
        table = read_array(file)
    except OSError as error:
        raise DataError(f"cannot read {file}: {error.strerror or one_line(error)}") from error
    except Exception as error:  # numpy raises ValueError, EOFError, SyntaxError, OverflowError and more
        raise DataError(f"{file} is not a numpy array: {one_line(error)}") from error
    if table.ndim != 2 or table.shape[1] != 17 or table.dtype.kind not in "fiu":
        raise DataError(f"{file} holds an array of shape {table.shape}; it must be numbers of shape (images, 17)")
    if len(table) != count:
        raise DataError(
            f"{file} has poses of {len(table)} images, but there are {count} images; remove images without a pose"
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
            raise DataError(
                f"{file}: row {row}: height {height}, width {width} or focal length {focal} is out of range"
            )
        near, far = bounds[row].tolist()
        if not 0 < near < far < float("inf"):
            raise DataError(
                f"{file}: row {row}: the depth bounds are {near} and {far}; they must be positive and ascending"
            )
    height, width, focal = camera.unbind(-1)
    intrinsics = torch.stack([focal, focal, width / 2, height / 2], dim=-1)
    return poses, intrinsics, torch.stack([width, height], dim=-1).round().long(), bounds


def faces_forward(poses: Tensor) -> bool:
    """Return whether the cameras with `poses` (M, 3, 4) all look in about the same direction."""
    back = poses[:, :, 2]
    mean = back.mean(0)
    return bool(((back @ mean) >= MIN_FORWARD_COSINE * mean.norm()).all()) and bool(mean.norm() > 0)


def corner_directions(poses: Tensor, intrinsics: Tensor, sizes: Tensor) -> Tensor:
    """Return directions (M, 4, 3) of depth 1 through the image corners of M pinhole cameras.

    `poses` are (M, 3, 4) camera-to-world, `intrinsics` (M, 4) fx, fy, cx, cy and `sizes` (M, 2) widths and heights,
    pixels.
    """
    sides = torch.tensor([[0, 0], [1, 0], [0, 1], [1, 1]])
    x, y = ((sides * sizes[:, None] - intrinsics[:, None, 2:]) / intrinsics[:, None, :2]).unbind(-1)
    return torch.stack([x, -y, -torch.ones_like(x)], dim=-1) @ poses[:, :, :3].transpose(1, 2)


def _in_ndc(scene: ParsedScene, poses: Tensor, corners: Tensor, nears: Tensor) -> ParsedScene:
    """Return the scene in normalised device coordinates; everything visible is in the box."""
    ndc = find_ndc(poses, corners, nears)
    box = checked_box(ndc_box(ndc, poses, corners).float(), BOUNDS)
    cameras = NdcCameras(**{f.name: getattr(scene.cameras, f.name) for f in fields(scene.cameras)}, ndc=ndc)
    # No ray is longer than the diagonal of the box.
    return replace(scene, cameras=cameras, box=box, near=0.0, far=float((box[1] - box[0]).norm()), unbounded=False)


def _image_names(root: Path) -> list[str]:
    """Return the sorted names of the images in a folder or, if there are none, in the first folder of reduced images.

    Raises:
        DataError: if there are no images.
    """
    folders = [reduced_folder(root, factor) for factor in REDUCED]
    for folder in folders:
        if names := image_names(folder):
            return names
    listed = ", ".join(folder.name for folder in folders)
    raise DataError(
        f"{root.parent} has no images in {listed}; put them there, or name their folder: --images-path FOLDER"
    )
