"""Folders of IDR and NeuS: images, masks of the object, and cameras_sphere.npz, as for DTU and BlendedMVS.

The file has for each view the projection `world_mat_i` to pixels, and `scale_mat_i`, which maps the unit sphere around
the object to the world (Yariv et al. 2020; Wang et al. 2021). The first pixel's centre is taken to be at 0.5, as
COLMAP has it: docs/notes/images.md has the measurement.
"""

from __future__ import annotations

import re
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from nerfloom import DataError, ParsedScene
from nerfloom.base.arrays import read_small_arrays
from nerfloom.base.console import say
from nerfloom.base.errors import one_line
from nerfloom.base.splits import Split
from nerfloom.cameras.cameras import MAX_SIDE, check_pose
from nerfloom.data.scene import PoseSource
from nerfloom.dataparsers.captured import captured_scene, has_transforms, image_sizes
from nerfloom.dataparsers.colmap_model import find_models
from nerfloom.dataparsers.llff import POSES
from nerfloom.dataparsers.numbered import image_names, partners
from nerfloom.dataparsers.posed_images import Captured, PosedImages, StatedRegion
from nerfloom.dataparsers.projections import check_skew, factored, size_made_for
from nerfloom.dataparsers.sdfstudio import META

CAMERAS = ("cameras_sphere.npz", "cameras.npz")
"""Names of the cameras' file; the first has the sphere nearest to the object."""
IMAGES = ("image", "images", "rgb", "rgbs", "imgs")
MASKS = ("mask", "masks")
"""Names of the folders of images and masks."""
ENTRY = re.compile(r"(world_mat|scale_mat|camera_mat)_(\d{1,9})")
"""Arrays that are read: kind and number."""
LARGEST_ENTRY = 4096
"""Maximum size of such an array's entry in the file, bytes; a 4x4 matrix takes 256."""
SIMILAR = 1e-3
"""Maximum relative deviation of a scale_mat from a similarity transform, and between the scale_mats of two views."""


@dataclass(frozen=True)
class Dtu(Captured):
    """Flags of the dtu format."""

    poses: PoseSource = "exact"
    cameras_path: str | None = None
    """File of the cameras in the data folder. Default: cameras_sphere.npz, otherwise cameras.npz."""
    images_path: str | None = None
    """Folder of the images in the data folder. Default: the first of image, images, rgb, rgbs, imgs."""
    masks_path: str | None = None
    """Folder of masks in the data folder: white for the object. Default: mask or masks, if there is one."""
    camera_width: int | None = None
    """Width of the images that the cameras were made for, pixels. Default: a multiple or a fraction of the images'
    width, by the principal point."""

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        there = any((path / name).is_file() for name in CAMERAS) and any((path / name).is_dir() for name in IMAGES)
        others = has_transforms(path) or (path / POSES).is_file() or (path / META).is_file()
        return there and not others and not find_models(path)

    def parse(self, path: Path | None, split: Split) -> ParsedScene:
        if path is None:
            raise DataError("the dtu format needs a folder: --data DIR")
        if self.camera_width is not None and not 1 <= self.camera_width <= MAX_SIDE:
            raise DataError(f"--camera-width is {self.camera_width}; it must be from 1 to {MAX_SIDE} pixels")
        quiet = split != "train"
        file = path / (self.cameras_path or _first(path, CAMERAS))
        views = read_views(file)
        folder = path / (self.images_path or _first(path, IMAGES))
        names = image_names(folder)
        if not names:
            raise DataError(f"{path} has no images in {folder.name}; name their folder: --images-path FOLDER")
        names, numbers = _with_cameras(names, list(views["world_mat"]), file, quiet)
        images = self._posed(file, views, [folder / name for name in names], numbers, quiet)
        masks = path / (self.masks_path or _first(path, MASKS))
        if mask_names := image_names(masks):
            images = replace(images, masks=_masks(names, masks, mask_names, quiet))
        elif self.masks_path is not None:
            raise DataError(f"--masks-path {self.masks_path}: there are no masks in {masks}")
        return captured_scene(self, images, split)

    def _posed(
        self, file: Path, views: Mapping[str, Mapping[int, Tensor]], paths: list[Path], numbers: list[int], quiet: bool
    ) -> PosedImages:
        """Return the images with the cameras of these numbers, without masks."""
        labels = [f"{file}: world_mat_{number}" for number in numbers]
        projections = factored(torch.stack([views["world_mat"][number] for number in numbers]), labels)
        for pose, label in zip(projections.poses, labels, strict=True):
            check_pose(pose, label)
        actual = image_sizes(paths)
        stated = _stated_size(views["camera_mat"].get(numbers[0]))
        principal = projections.intrinsics[:, 2:]
        sizes, reason = size_made_for(principal, actual, stated, self.camera_width, str(file))
        if not quiet:
            (across, down), (width, height) = sizes[0].tolist(), actual[0].tolist()
            say(f"{file}: cameras are for {across}x{down} pixels, {reason}; images are {width}x{height}")
        check_skew(projections.skews, projections.intrinsics, sizes, labels, quiet)
        return PosedImages(
            folder=paths[0].parent.parent,
            paths=tuple(paths),
            names=tuple(path.name for path in paths),
            poses=projections.poses,
            intrinsics=projections.intrinsics,
            sizes=sizes,
            region=_sphere(file, views["scale_mat"], numbers, quiet),
        )


def read_views(file: Path) -> dict[str, dict[int, Tensor]]:
    """Read the matrices of cameras_sphere.npz.

    Args:
        file: the file.

    Returns:
        world_mat, scale_mat and camera_mat -> number of a view, ascending -> (3, 4) float64, without the last row.

    Raises:
        DataError: if the file is missing, damaged or holds pickled objects, if an array is not a matrix of numbers, or
            if there is no world_mat.
    """
    try:
        arrays = read_small_arrays(file, lambda name: ENTRY.fullmatch(name) is not None, LARGEST_ENTRY)
    except zipfile.BadZipFile as error:
        raise DataError(f"{file} is not an archive of numpy's (.npz), or it is damaged; copy it again") from error
    except OSError as error:
        raise DataError(f"cannot read {file}: {error.strerror or one_line(error)}") from error
    except Exception as error:  # numpy, zipfile and zlib raise ValueError, EOFError, SyntaxError, zlib.error and more
        raise DataError(f"{file} is damaged: {one_line(error)}") from error
    views: dict[str, dict[int, Tensor]] = {"world_mat": {}, "scale_mat": {}, "camera_mat": {}}
    for name, array in arrays.items():
        kind, number = ENTRY.fullmatch(name).groups()  # type: ignore[union-attr]  # as they were chosen
        if array.shape not in ((4, 4), (3, 4)):
            raise DataError(f"{file}: {name} has shape {array.shape}; it must be (4, 4) or (3, 4)")
        views[kind][int(number)] = torch.from_numpy(array[:3].astype(np.float64))
    if not views["world_mat"]:
        raise DataError(f"{file} has no projections: no array is called world_mat_0, world_mat_1, ...")
    return {kind: dict(sorted(of_kind.items())) for kind, of_kind in views.items()}


def _first(path: Path, names: Sequence[str]) -> str:
    """Return the first of the names that exists in a folder, or the first if none does."""
    return next((name for name in names if (path / name).exists()), names[0])


def _with_cameras(names: list[str], numbers: list[int], file: Path, quiet: bool) -> tuple[list[str], list[int]]:
    """Return the names of images that have a camera, and the numbers of their cameras."""
    found, common = partners(names, [str(number) for number in numbers])
    chosen = [(name, numbers[place]) for name, place in zip(names, found, strict=True) if place is not None]
    if not chosen:
        raise DataError(
            f"{file} has {len(numbers)} cameras, the first world_mat_{numbers[0]}, but none for any of the "
            f"{len(names)} images, such as {names[0]}: name images by the numbers of their cameras"
        )
    if not quiet:
        if common == "order":
            say(f"{file}: its cameras are assigned to images in the order of their names, as the numbers differ")
        if len(chosen) < len(names):
            first = next(name for name, place in zip(names, found, strict=True) if place is None)
            missing = len(names) - len(chosen)
            say(f"{file}: {missing} of {len(names)} images have no camera and are skipped, the first {first}")
        if len(chosen) < len(numbers):
            say(f"{file}: {len(numbers) - len(chosen)} of {len(numbers)} cameras have no image")
    return [name for name, _ in chosen], [number for _, number in chosen]


def _masks(names: list[str], folder: Path, masks: list[str], quiet: bool) -> tuple[Path | None, ...]:
    """Return the mask of each image, None for an image without."""
    found, common = partners(names, masks)
    missing = found.count(None)
    if missing == len(names):
        raise DataError(f"{folder}: no image, like {names[0]}, has one of its {len(masks)} masks, like {masks[0]}")
    if not quiet:
        if common == "order":
            say(f"{folder}: masks are assigned to images in the order of their names, as these differ")
        if (extra := len(masks) - len(names) + missing) > 0:
            say(f"{folder}: {extra} of {len(masks)} masks have no image")
    return tuple(None if place is None else folder / masks[place] for place in found)


def _stated_size(matrix: Tensor | None) -> tuple[float, float] | None:
    """Return width and height by a camera_mat that maps pixels to -1 to 1; None if there is none, or it does not."""
    if matrix is None or not bool(matrix.isfinite().all()):
        return None
    across, down = float(matrix[0, 0]), float(matrix[1, 1])
    maps = abs(float(matrix[0, 2]) + 1) < SIMILAR and abs(float(matrix[1, 2]) + 1) < SIMILAR
    if not maps or not min(across, down) > 2 / MAX_SIDE or max(across, down) > 2:
        return None
    return 2 / across, 2 / down


def _sphere(file: Path, matrices: Mapping[int, Tensor], numbers: list[int], quiet: bool) -> StatedRegion | None:
    """Return the unit sphere transformed by the views' scale_mat; None if they have none."""
    used = [(number, matrices[number]) for number in numbers if number in matrices]
    if not used:
        if not quiet:
            say(f"{file} has no scale_mat, so nothing says where the object is; the scene is placed by its cameras")
        return None
    number, first = used[0]
    radius = float(torch.linalg.det(first[:, :3]).abs()) ** (1 / 3)
    off = first[:, :3].T @ first[:, :3] / max(radius, 1e-300) ** 2 - torch.eye(3, dtype=torch.float64)
    if not bool(first.isfinite().all()) or not radius > 0 or not bool((off.abs() < SIMILAR).all()):
        raise DataError(
            f"{file}: scale_mat_{number} does not map the unit sphere to a sphere; it must be a scale and a shift"
        )
    for other, matrix in used:
        if not bool(((matrix - first).abs() <= SIMILAR * radius).all()):
            raise DataError(
                f"{file}: scale_mat_{other} differs from scale_mat_{number}; all views show the same sphere"
            )
    return StatedRegion(first[:, 3], torch.full((3,), radius, dtype=torch.float64), is_ball=True)
