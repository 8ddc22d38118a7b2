"""Captured scenes: placement, sizes and splits, shared by all formats of posed images."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from nerfloom import Cameras, DataError, ParsedScene
from nerfloom.base.console import say
from nerfloom.base.splits import Split
from nerfloom.cameras.poses import Placement, estimate_near, held_out
from nerfloom.data.dataset import existing_files
from nerfloom.data.exposure import read_taken
from nerfloom.data.image_files import image_size
from nerfloom.data.names_on_disk import (
    LIKELIEST,
    REDUCED,
    are_files,
    distinct_names,
    files_in,
    nearest_on_disk,
    reduced_folder,
)
from nerfloom.dataparsers.placing import Applied, placement_of
from nerfloom.dataparsers.posed_images import Captured, PosedImages, StatedRegion
from nerfloom.dataparsers.region import distances
from nerfloom.dataparsers.sparse_points import sparse_points
from nerfloom.geometry.lenses import LENSES

MAX_SIDE = 1600
"""Images with a longer side above this, pixels, are reduced by default."""
MAX_MAGNITUDE = 1e9
"""Maximum of focal lengths, principal points (pixels) and boxes (scene units), because float32 may overflow beyond it;
focal lengths must also exceed its inverse."""
ASPECT_TOLERANCE = 0.03
"""Relative difference between the aspect ratios of an image and its camera that rounded sizes can explain."""


Division = Callable[[list[str]], Tensor]
"""Function from the names of all existing images to the indices (S,) of a split's images."""


def captured_scene(
    flags: Captured,
    images: PosedImages,
    split: Split,
    division: Division | None = None,
    applied: Applied | None = None,
) -> ParsedScene:
    """Return the images of one split, placed together with the images of the others.

    Missing image files are reported once and left out before any decision.

    Args:
        flags: the format's flags.
        images: images of all splits.
        division: selects the split's images; by default, every `eval_interval`-th image is held out.
        applied: the transform already applied to the poses, if the caller undoes it by `from_original`.

    Raises:
        DataError: if a flag or a camera is invalid, a camera does not fit its image, or a mask is missing.
    """
    _check_flags(flags)
    originals = images.paths
    images, reduction = _choose_files(images, flags.downscale_factor, quiet=split != "train")
    if split == "train" and images.taken is None and images.paths != originals:
        files = [one if one.is_file() else other for one, other in zip(originals, images.paths, strict=True)]
        images = replace(images, taken=read_taken(files))  # reduced copies often have no EXIF
    images = images[existing_files(images.paths, split)]
    if images.region is not None and images.masks is not None:
        images = images[_with_mask(images, split)]
    chosen = (division or partial(held_out, split=split, every=flags.eval_interval))(list(images.names))
    if len(chosen) == 0:
        raise DataError(
            f"{images.folder}: split '{split}' has none of the {len(images.names)} images; "
            "--eval-interval 0 uses all in every split"
        )
    placement = placement_of(flags, images, split, applied)
    cameras = placed_cameras(images, placement)
    sparse = sparse_points(images, placement, cameras, chosen if split == "train" else None)
    near = min(estimate_near(cameras, sparse.sound), flags.far / 2) if flags.near is None else flags.near
    box = _box(flags, images.region, placement)
    shows_object = images.region is not None and images.masks is not None
    names, images = _names_of(images, chosen), images[chosen]
    _check_masks(images.masks)
    return ParsedScene(
        image_paths=images.paths,
        cameras=cameras[chosen],
        box=box,
        near=near,
        far=flags.far,
        times=images.times,
        transform=placement.transform,
        scale=placement.scale,
        downscale_factor=reduction,
        mask_paths=images.masks,
        points=sparse.points,
        observations=None if sparse.observations is None else sparse.observations.of_images(chosen),
        sightings=None if sparse.sightings is None else sparse.sightings.of_images(chosen),
        unbounded=True,
        poses=flags.poses,
        z_is_up=flags.orientation_method in ("auto", "up"),
        depth_paths=images.depths,
        object_distances=_object_distances(flags, cameras, box) if shows_object else None,
        taken=images.taken,
        names=names,
    )


def _names_of(images: PosedImages, chosen: Tensor) -> tuple[str, ...]:
    """Return the names of the `chosen` (S,) images, with the folders that tell all `images` apart."""
    names = distinct_names(images.paths)
    return tuple(names[index] for index in chosen.tolist())


def image_sizes(paths: Sequence[Path]) -> Tensor:
    """Return width and height (M, 2) int64 of images `paths` by their headers; unreadable ones get the first.

    Raises:
        DataError: if no file is readable.
    """
    default = image_size(paths)
    sizes = []
    for path in paths:
        try:
            sizes.append(image_size([path]))
        except DataError:  # reported and skipped when it is decoded
            sizes.append(default)
    return torch.tensor(sizes)


def sizes_of(stated: Sequence[Sequence[int | None]], unstated: Callable[[], Tensor]) -> Tensor:
    """Return width and height (M, 2) int64 for intrinsics: as stated, or the image's if any is missing.

    Args:
        stated: M widths and heights; None for missing values.
        unstated: returns width and height (M, 2) int64 of the images; called if any is missing.
    """
    if not any(None in size for size in stated):
        return torch.tensor(stated)
    actual = unstated().tolist()
    return torch.tensor([found if None in size else size for size, found in zip(stated, actual, strict=True)])


def has_transforms(path: Path) -> bool:
    """Return whether the folder `path` has transforms*.json, which take precedence over files of other formats."""
    return any((path / f"transforms{part}.json").is_file() for part in ("", "_train"))


def _check_flags(flags: Captured) -> None:
    factor = flags.downscale_factor
    if factor is not None and factor < 1:
        raise DataError(f"--downscale-factor is {factor}; it must be an integer of at least 1")
    if flags.eval_interval < 0:
        raise DataError(f"--eval-interval is {flags.eval_interval}; it must be an integer of at least 0")
    for name in ("scale_factor", "scene_scale"):
        value = getattr(flags, name)
        if not 0 < value < math.inf:
            raise DataError(f"--{name.replace('_', '-')} is {value}; it must be above zero")
    if flags.near is not None and not 0 <= flags.near < flags.far:
        raise DataError(f"--near {flags.near} and --far {flags.far}: near must be at least 0 and less than far")


def _choose_files(images: PosedImages, factor: int | None, quiet: bool) -> tuple[PosedImages, int]:
    """Return the images with the files to read, and their reduction factor when loading.

    A folder of reduced images that lacks some, as after a stopped command, is not used, and reported unless `quiet`.
    """
    folder, paths = images.folder, images.paths
    root = _shared_folder(folder, paths)
    steps = sorted({*REDUCED, factor or 1})
    found = {step: _reduced(paths, root, step) for step in steps}
    counts = {step: len(paths) - files.count(None) for step, files in found.items()}
    most = max(counts.values())
    if most == 0:
        return images, 1  # `existing_files` reports it
    available = [step for step in steps if counts[step] == most or (step == 1 and counts[step])]
    partial = [str(step) for step in steps if counts[step] and step not in available]
    if partial and not quiet:
        say(f"{root}: not all images have one reduced by {' and '.join(partial)} beside them; these are not used")
    if factor is None:
        factor = available[0]
        side = max(image_size([path for path in found[factor] if path is not None])) * factor
        while side > MAX_SIDE * factor:
            factor *= 2
    fitting = [step for step in available if factor % step == 0]
    if not fitting:
        raise DataError(
            f"{root}: there are no images for --downscale-factor {factor}, only images reduced by "
            f"{' or '.join(map(str, available))}; set --downscale-factor {available[0]} or leave it out"
        )
    step = fitting[-1]
    images = replace(
        images,
        paths=tuple(small or path for small, path in zip(found[step], _named(paths, root, step), strict=True)),
        masks=_beside(folder, images.masks, step),
        depths=_beside(folder, images.depths, step),
    )
    return images, factor // step


def _shared_folder(folder: Path, paths: Sequence[Path]) -> Path | None:
    """Return the subfolder of `folder` that contains all files, or None."""
    inside = [path.relative_to(folder).parts if path.is_relative_to(folder) else () for path in paths]
    tops = {parts[0] if len(parts) > 1 else ".." for parts in inside}
    return folder / tops.pop() if len(tops) == 1 and ".." not in tops else None


def _named(paths: Sequence[Path], root: Path | None, step: int) -> list[Path]:
    """Return the paths of images reduced by `step` in a folder beside `root`, with the originals' names."""
    if step == 1 or root is None:
        return list(paths)
    folder = reduced_folder(root, step)
    return [folder / path.relative_to(root) for path in paths]


def _reduced(paths: Sequence[Path], root: Path | None, step: int) -> list[Path | None]:
    """Return the files of images reduced by `step`, whose names may have another ending; None for missing ones."""
    if step == 1:
        return [path if exists else None for path, exists in zip(paths, are_files(paths), strict=True)]
    if root is None or not reduced_folder(root, step).is_dir():
        return [None] * len(paths)
    named = _named(paths, root, step)
    listed = files_in(path.parent for path in named)
    found: list[Path | None] = []
    for path in named:
        names = listed[path.parent]
        tried = (path.name.lower(), *(f"{path.stem}{ending}".lower() for ending in LIKELIEST))
        name = next((names[each] for each in tried if each in names), None)
        found.append(None if name is None else path.with_name(name))
    return found


def _beside(folder: Path, paths: tuple[Path | None, ...] | None, step: int) -> tuple[Path | None, ...] | None:
    """Return the masks or depths for images reduced by `step`: reduced ones if they exist, otherwise the originals."""
    if paths is None:
        return None
    given = [path for path in paths if path is not None]
    reduced = iter(_reduced(given, _shared_folder(folder, given), step))
    return tuple(path and (next(reduced) or path) for path in paths)


def _with_mask(images: PosedImages, split: Split) -> Tensor:
    """Return the indices of images with a mask. Others would show the surroundings that masks call empty."""
    masks = images.masks or ()
    kept = [index for index, mask in enumerate(masks) if mask is not None]
    if len(kept) < len(masks) and split == "train":
        first = images.names[masks.index(None)]
        missing = len(masks) - len(kept)
        say(f"{images.folder}: {missing} of {len(masks)} images have no mask and are skipped, the first {first}")
    return torch.tensor(kept, dtype=torch.int64)


def _box(flags: Captured, region: StatedRegion | None, placement: Placement) -> Tensor:
    """Return the region of interest (2, 3): the cube around the origin, or the box around the one that is stated."""
    if region is None:
        return torch.tensor([[-1.0], [1.0]]).expand(2, 3) * flags.scene_scale
    half = region.half if region.is_ball else placement.transform[:, :3].abs() @ region.half
    center, half = placement.points(region.center[None])[0], half * placement.scale * flags.scene_scale
    return checked_box(torch.stack([center - half, center + half]).float(), "the region of interest and --scene-scale")


def _object_distances(flags: Captured, cameras: Cameras, box: Tensor) -> tuple[float, float]:
    """Return near and far for an object in `box`, within those of the flags."""
    first, last = distances(cameras, box.double())
    near, far = max(first, flags.near or 0.0), min(last, flags.far)
    if near >= far:
        raise DataError(
            f"--near {flags.near} and --far {flags.far} leave nothing of the object, which is {first:.4g} to "
            f"{last:.4g} scene units from the cameras; leave them out, or choose others"
        )
    return near, far


def _check_masks(masks: tuple[Path | None, ...] | None) -> None:
    missing = [path for path in masks or () if path is not None and not path.is_file()]
    if missing:
        raise DataError(
            f"the mask {missing[0]} does not exist (missing in all: {len(missing)}): {nearest_on_disk(missing[0])}; "
            "restore it, or remove its name"
        )


def checked_box(box: Tensor, source: str) -> Tensor:
    """Return `box` (2, 3) if it is valid; the message names its `source` as a plural subject.

    Raises:
        DataError: if the box is empty or too large.
    """
    if not bool((box.abs() < MAX_MAGNITUDE).all()) or not bool((box[0] < box[1]).all()):
        raise DataError(f"{source} give a box that is empty or too large; change them")
    return box


def placed_cameras(images: PosedImages, placement: Placement) -> Cameras:
    """Return the cameras of `images` in the frame of `placement`, for the sizes of the image files.

    Raises:
        DataError: if a camera is invalid or does not fit its image.
    """
    sizes = image_sizes(images.paths)
    _check_intrinsics(images, sizes)
    ratio = sizes / images.sizes
    intrinsics = images.intrinsics * ratio.repeat(1, 2)
    if images.model == "orthographic":
        intrinsics[:, :2] /= placement.scale
    _check_range(images, intrinsics)
    poses = placement.poses(images.poses).float()
    if not bool(poses.isfinite().all()):
        raise DataError(f"{images.folder}: positions of cameras are too large; use --auto-scale-poses True")
    fx, fy, cx, cy = intrinsics.float().unbind(-1)
    widths, heights = sizes.unbind(-1)
    lens = images.lens
    if images.model == "opencv" and not bool((lens if lens is not None else fx * 0).any()):
        return Cameras(poses, fx, fy, cx, cy, widths, heights)
    return Cameras(poses, fx, fy, cx, cy, widths, heights, images.model, lens)


def _check_intrinsics(images: PosedImages, sizes: Tensor) -> None:
    """Refuse `images` with invalid cameras, or of another aspect ratio than their files' `sizes` (M, 2)."""
    numbers = (images.intrinsics, images.sizes, sizes)
    for path, values, stated, actual in zip(images.paths, *(part.tolist() for part in numbers), strict=True):
        if not all(map(math.isfinite, values)) or min(values[:2]) <= 0 or min(stated) <= 0:
            raise DataError(
                f"{path}: its camera has fx, fy, cx, cy = {values} for {stated[0]}x{stated[1]} pixels; "
                "focal lengths and sizes must be above zero"
            )
        # Rounding to whole pixels changes the aspect ratio of small images more.
        slack = ASPECT_TOLERANCE + 1 / min(actual)
        if abs(math.log(actual[0] * stated[1] / (actual[1] * stated[0]))) > slack:
            remedy = "it was cropped or rotated; restore it, or remove it from the data"
            if abs(math.log(actual[0] * stated[0] / (actual[1] * stated[1]))) <= slack:
                # The camera's program obeys EXIF, which COLMAP and others ignore.
                remedy = "it is stored on its side; turn such images as EXIF says: mogrify -auto-orient IMAGES"
            raise DataError(
                f"{path} is {actual[0]}x{actual[1]} pixels, but its camera is for {stated[0]}x{stated[1]}: {remedy}"
            )
    lens, expected = images.lens, len(LENSES[images.model])
    if lens is not None and (lens.shape[1] != expected or not bool(lens.isfinite().all())):
        raise DataError(f"{images.folder}: camera model '{images.model}' needs {expected} finite coefficients")


def _check_range(images: PosedImages, intrinsics: Tensor) -> None:
    """Refuse `images` with `intrinsics` (M, 4) fx, fy, cx, cy, pixels, beyond the range of float32."""
    usable = (intrinsics[:, :2] > 1 / MAX_MAGNITUDE).all(-1) & (intrinsics.abs() < MAX_MAGNITUDE).all(-1)
    if not bool(usable.all()):
        first = int(usable.int().argmin())
        values = ", ".join(f"{value:.3g}" for value in intrinsics[first].tolist())
        raise DataError(
            f"{images.paths[first]}: its camera has fx, fy, cx, cy = {values} pixels: out of range; correct them, or "
            "remove the image from the data"
        )
