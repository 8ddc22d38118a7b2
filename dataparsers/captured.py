"""Captured scenes: what all formats of posed photographs share - their placement, sizes and splits."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from framework import Cameras, DataError, DataParser, ParsedScene
from framework.cameras.cameras import LENSES
from framework.cameras.poses import Center, Orientation, Placement, held_out, nearest_shown, place
from framework.data.dataset import Split, existing, image_size
from framework.data.scene import PoseSource

LARGEST_SIDE = 1600
"""Pixels of an image's longer side above which images are reduced unless the user says by how much."""
REDUCED = (1, 2, 4, 8)
"""Whole numbers by which images are customarily reduced beforehand: those of `images` by 2 are in `images_2`."""
ENDINGS = (".png", ".jpg", ".jpeg", ".JPG", ".JPEG", ".PNG", ".webp")
"""Endings that a reduced image may have instead of its original's."""
EXTREME = 1e9
"""Pixels of a focal length, and to a principal point, and scene units of a box from which on float32 is in danger of
overflowing; focal lengths below its inverse are, too."""
ASPECT_TOLERANCE = 0.03
"""Relative difference between the shapes of an image and of its camera that rounding sizes can explain."""


@dataclass(frozen=True)
class Captured(DataParser):
    """Flags of every format of posed photographs. Subclasses add `recognizes` and `parse`."""

    downscale_factor: int | None = None
    """Reduce images by this whole number; images reduced already are taken from folders such as images_2. By
    default the smallest power of two that leaves the longer side at most 1600 pixels."""
    scale_factor: float = 1.0
    """Multiply camera positions by this, after automatic scaling."""
    scene_scale: float = 1.0
    """Half the edge of the box around the origin that holds the part of the scene that matters, scene units."""
    orientation_method: Orientation = "up"
    """Which way is up: the cameras' mean up direction, the one of their positions' least spread (pca), or as it is."""
    center_method: Center = "poses"
    """What becomes the origin: the cameras' mean position, the point they look at (focus), or as it is."""
    auto_scale_poses: bool = True
    """Scale camera positions to fit the box from -1 to 1."""
    eval_interval: int = 8
    """Hold out every so many-th photograph by sorted name, for val and test alike; 0 holds out none."""
    near: float | None = None
    """Distance from a camera at which the scene may start, scene units. If not given: half of that at which photographs
    show their nearest sparse points, else 0.05."""
    far: float = 1000.0
    """Distance from a camera at which the scene ends, scene units."""
    poses: PoseSource = "photographs"
    """Where the poses come from: exact, found in the photographs (structure from motion), or tracked by the device;
    methods may refine them accordingly."""


@dataclass(frozen=True)
class Photographs:
    """M photographs as a format's files describe them, of all splits, before any image is looked at."""

    folder: Path
    """Where the folder with the images is; reduced images are in folders beside that one."""
    paths: tuple[Path, ...]
    """M image files at full size. They may be missing where images reduced beforehand are there."""
    names: tuple[str, ...]
    """M names by which photographs are sorted and held out."""
    poses: Tensor
    """(M, 3 or 4, 4) camera-to-world, OpenGL axes, the input's frame and units; checked with `check_pose`."""
    intrinsics: Tensor
    """(M, 4) fx, fy, cx, cy in pixels of an image of `sizes`; of orthographic cameras pixels per unit of the input."""
    sizes: Tensor
    """(M, 2) int64 width and height that the intrinsics are for, whatever the size of the image files."""
    model: str = "pinhole"
    """Name of the projection, a key of `LENSES`."""
    lens: Tensor | None = None
    """(M, K) distortion coefficients in the order of `LENSES[model]`; None for all zero."""
    masks: tuple[Path | None, ...] | None = None
    """M images, white where a photograph is to be learnt from."""
    depths: tuple[Path | None, ...] | None = None
    """M images of depth."""
    times: Tensor | None = None
    """(M,) in [0, 1]."""
    points: Tensor | None = None
    """(K, 3) sparse points, the input's frame."""

    def __getitem__(self, index: Tensor) -> Photographs:
        """The photographs chosen by an index tensor."""
        chosen = index.tolist()
        return replace(
            self,
            paths=tuple(self.paths[i] for i in chosen),
            names=tuple(self.names[i] for i in chosen),
            poses=self.poses[index],
            intrinsics=self.intrinsics[index],
            sizes=self.sizes[index],
            lens=None if self.lens is None else self.lens[index],
            masks=None if self.masks is None else tuple(self.masks[i] for i in chosen),
            depths=None if self.depths is None else tuple(self.depths[i] for i in chosen),
            times=None if self.times is None else self.times[index],
        )


Division = Callable[[list[str]], Tensor]
"""From the names of the photographs that exist to the indices (S,) of those of a split."""


def captured_scene(
    flags: Captured, photographs: Photographs, split: Split, division: Division | None = None
) -> ParsedScene:
    """The photographs of one split, placed together with those of the others.

    Photographs without an image file are reported once and left out before anything else is decided.

    Args:
        division: which of the photographs are the split's; by default every `eval_interval`-th is held out.
    Raises: DataError for flags that make no sense, missing masks, cameras that are none or do not fit their images.
    """
    _check_flags(flags)
    photographs, reduction = _choose_files(photographs, flags.downscale_factor)
    photographs = photographs[existing(photographs.paths, split)]
    names = list(photographs.names)
    chosen = held_out(names, split, flags.eval_interval) if division is None else division(names)
    if len(chosen) == 0:
        raise DataError(
            f"{photographs.folder}: split '{split}' has none of the {len(names)} images; "
            "--eval-interval 0 uses all in every split"
        )
    placement = place(photographs.poses, flags.orientation_method, flags.center_method, flags.auto_scale_poses)
    placement = replace(placement, scale=placement.scale * flags.scale_factor)
    points = None if photographs.points is None else _placed(photographs.points, placement)
    cameras = _cameras(photographs, placement)
    near = min(nearest_shown(cameras, points), flags.far / 2) if flags.near is None else flags.near
    photographs = photographs[chosen]
    _check_masks(photographs.masks)
    return ParsedScene(
        image_paths=photographs.paths,
        cameras=cameras[chosen],
        box=torch.tensor([[-1.0], [1.0]]).expand(2, 3) * flags.scene_scale,
        near=near,
        far=flags.far,
        times=photographs.times,
        transform=placement.transform,
        scale=placement.scale,
        downscale_factor=reduction,
        mask_paths=photographs.masks,
        points=points,
        unbounded=True,
        poses=flags.poses,
        depth_paths=photographs.depths,
    )


def from_original(scene: ParsedScene, applied: Tensor, scale: float = 1.0) -> ParsedScene:
    """The scene with `transform` and `scale` that start one step earlier.

    Args:
        applied, scale: (4, 4) rigid; a point x of the original is `scale * (applied @ x)` in the frame that the
            scene's transform has started from so far.
    """
    transform = torch.eye(4)[:3] if scene.transform is None else scene.transform
    # s (R (a A x) + t) = s a (R A x + t / a)
    moved = transform[:, :3].double() @ applied[:3].double()
    moved[:, 3] += transform[:, 3] / scale
    return replace(scene, transform=moved.float(), scale=scene.scale * scale)


def image_sizes(paths: Sequence[Path]) -> Tensor:
    """(M, 2) int64 width and height of images, from their headers; of unreadable ones that of the first readable.

    Raises: DataError where none can be read.
    """
    usual = image_size(paths)
    sizes = []
    for path in paths:
        try:
            sizes.append(image_size([path]))
        except DataError:  # reported and skipped when it is decoded
            sizes.append(usual)
    return torch.tensor(sizes)


def has_transforms(path: Path) -> bool:
    """Whether a folder has transforms*.json, which other formats' files beside it then yield to."""
    return any((path / f"transforms{part}.json").is_file() for part in ("", "_train"))


def _check_flags(flags: Captured) -> None:
    factor = flags.downscale_factor
    if factor is not None and factor < 1:
        raise DataError(f"--downscale-factor is {factor}; it must be a whole number from 1")
    if flags.eval_interval < 0:
        raise DataError(f"--eval-interval is {flags.eval_interval}; it must be a whole number from 0")
    for name in ("scale_factor", "scene_scale"):
        value = getattr(flags, name)
        if not 0 < value < math.inf:
            raise DataError(f"--{name.replace('_', '-')} is {value}; it must be above zero")
    if flags.near is not None and not 0 <= flags.near < flags.far:
        raise DataError(f"--near {flags.near} and --far {flags.far}: near must be from 0 and below far")


def _choose_files(photographs: Photographs, factor: int | None) -> tuple[Photographs, int]:
    """The photographs with the files to read them from, and by how much to reduce those when they are loaded."""
    folder, paths = photographs.folder, photographs.paths
    root = _shared_folder(folder, paths)
    steps = sorted({*REDUCED, factor or 1})
    there = [step for step in steps if any(_reduced(path, root, step).is_file() for path in paths)]
    if not there:
        return photographs, 1  # `existing` says so
    if factor is None:
        factor = there[0]
        files = [_reduced(path, root, factor) for path in paths]
        side = max(image_size([path for path in files if path.is_file()])) * factor
        while side > LARGEST_SIDE * factor:
            factor *= 2
    fitting = [step for step in there if factor % step == 0]
    if not fitting:
        raise DataError(
            f"{root}: no images are there for --downscale-factor {factor}, only images reduced by "
            f"{' or '.join(map(str, there))}; give --downscale-factor {there[0]} or leave it out"
        )
    step = fitting[-1]
    photographs = replace(
        photographs,
        paths=tuple(_reduced(path, root, step) for path in paths),
        masks=_beside(folder, photographs.masks, step),
        depths=_beside(folder, photographs.depths, step),
    )
    return photographs, factor // step


def _shared_folder(folder: Path, paths: Sequence[Path]) -> Path | None:
    """The folder directly in `folder` that all files are in; None where there is none."""
    inside = [path.relative_to(folder).parts if path.is_relative_to(folder) else () for path in paths]
    tops = {parts[0] if len(parts) > 1 else ".." for parts in inside}
    return folder / tops.pop() if len(tops) == 1 and ".." not in tops else None


def _reduced(path: Path, root: Path | None, step: int) -> Path:
    """Where an image reduced by `step` lies: in a folder beside `root`, under its original's name."""
    if step == 1:
        return path
    if root is None:
        return path / "there is none"
    folder = root.with_name(f"{root.name}_{step}")
    file = folder / path.relative_to(root)
    others = [file.with_suffix(ending) for ending in ENDINGS if folder.is_dir()]
    return next((other for other in (file, *others) if other.is_file()), file)


def _beside(folder: Path, paths: tuple[Path | None, ...] | None, step: int) -> tuple[Path | None, ...] | None:
    """Masks or depths that go with images reduced by `step`: reduced ones where there are any, else those named."""
    if paths is None:
        return None
    root = _shared_folder(folder, [path for path in paths if path is not None])
    reduced = [None if path is None else _reduced(path, root, step) for path in paths]
    return tuple(small if small and small.is_file() else path for small, path in zip(reduced, paths, strict=True))


def _check_masks(masks: tuple[Path | None, ...] | None) -> None:
    missing = [path for path in masks or () if path is not None and not path.is_file()]
    if missing:
        raise DataError(f"{missing[0]}: this mask is missing, and {len(missing) - 1} more; restore or unname them")


def checked_box(box: Tensor, source: str) -> Tensor:
    """A box (2, 3) that something can be in.

    Args:
        source: what it is made from, as a subject.
    Raises: DataError where it is none.
    """
    if not bool((box.abs() < EXTREME).all()) or not bool((box[0] < box[1]).all()):
        raise DataError(f"{source} make a box of no size or beyond measure")
    return box


def _placed(points: Tensor, placement: Placement) -> Tensor:
    """Sparse points (K, 3) in the scene's frame, without those that are too far away for float32."""
    points = _exact(placement).points(points.double()).float()
    return points[points.isfinite().all(-1)]


def _exact(placement: Placement) -> Placement:
    """In double precision: positions of a mapped scene may be millions of units from their origin."""
    return replace(placement, transform=placement.transform.double())


def _cameras(photographs: Photographs, placement: Placement) -> Cameras:
    """Cameras in the scene, with the sizes of the image files."""
    sizes = image_sizes(photographs.paths)
    _check_intrinsics(photographs, sizes)
    ratio = sizes / photographs.sizes
    intrinsics = photographs.intrinsics * ratio.repeat(1, 2)
    if photographs.model == "orthographic":
        intrinsics[:, :2] /= placement.scale
    _check_measure(photographs, intrinsics)
    poses = _exact(placement).poses(photographs.poses.double()).float()
    if not bool(poses.isfinite().all()):
        raise DataError(f"{photographs.folder}: positions of cameras are too large; leave --auto-scale-poses on")
    fx, fy, cx, cy = intrinsics.float().unbind(-1)
    widths, heights = sizes.unbind(-1)
    lens = photographs.lens
    if photographs.model == "opencv" and not bool((lens if lens is not None else fx * 0).any()):
        return Cameras(poses, fx, fy, cx, cy, widths, heights)
    return Cameras(poses, fx, fy, cx, cy, widths, heights, photographs.model, lens)


def _check_intrinsics(photographs: Photographs, sizes: Tensor) -> None:
    """Refuse cameras that see nothing, or an image of another shape.

    Args:
        sizes: (M, 2) width and height of the image files.
    """
    numbers = (photographs.intrinsics, photographs.sizes, sizes)
    for path, values, stated, found in zip(photographs.paths, *(part.tolist() for part in numbers), strict=True):
        if not all(map(math.isfinite, values)) or min(values[:2]) <= 0 or min(stated) <= 0:
            raise DataError(
                f"{path}: its camera has fx, fy, cx, cy = {values} for {stated[0]}x{stated[1]} pixels; "
                "focal lengths and sizes must be above zero"
            )
        # A pixel's rounding of the smaller sides counts for more the smaller the image is.
        slack = ASPECT_TOLERANCE + 1 / min(found)
        if abs(math.log(found[0] * stated[1] / (found[1] * stated[0]))) > slack:
            raise DataError(
                f"{path} is {found[0]}x{found[1]} pixels, but its camera is for the shape of "
                f"{stated[0]}x{stated[1]}: it was cropped or turned; restore it, or take it out of the data"
            )
    lens, expected = photographs.lens, len(LENSES[photographs.model])
    if lens is not None and (lens.shape[1] != expected or not bool(lens.isfinite().all())):
        raise DataError(f"{photographs.folder}: a lens '{photographs.model}' needs {expected} finite coefficients")


def _check_measure(photographs: Photographs, intrinsics: Tensor) -> None:
    """Refuse cameras that nothing can be computed with.

    Args:
        intrinsics: (M, 4) fx, fy, cx, cy in pixels of the image files.
    """
    usable = (intrinsics[:, :2] > 1 / EXTREME).all(-1) & (intrinsics.abs() < EXTREME).all(-1)
    if not bool(usable.all()):
        first = int(usable.int().argmin())
        values = ", ".join(f"{value:.3g}" for value in intrinsics[first].tolist())
        raise DataError(f"{photographs.paths[first]}: its camera has fx, fy, cx, cy = {values} pixels: beyond measure")
