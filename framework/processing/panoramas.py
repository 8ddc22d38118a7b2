"""Perspective views of panoramas with unknown poses, as images for COLMAP."""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from nerfloom.base.console import say
from nerfloom.base.errors import DataError
from nerfloom.processing.images import PreparedImage, in_parallel, output_names, prepare_all, save
from nerfloom.processing.listing import natural_order
from nerfloom.processing.transforms import Lens
from nerfloom.processing.unfinished import VIEWS
from nerfloom.processing.views import Views, cut

MAX_DEVIATION = 0.02
"""Maximum relative deviation of a panorama's width from twice its height."""


def write_views(folder: Path, sources: list[Path], work: Path, views: Views) -> tuple[Path, list[Path]]:
    """Cut panoramas into perspective views, unless a stopped run did.

    Views of one direction follow each other in the order of their names, so that they are matched as a walk is.

    Args:
        folder: folder of the panoramas.
        sources: their paths in it.
        work: folder of unfinished files.
        views: directions and angle.

    Returns:
        The folder of the views and their paths in it.

    Raises:
        DataError: if a panorama is not twice as wide as high, or none is readable.
    """
    target = work / VIEWS
    if target.is_dir():
        return target, _in_order(path.relative_to(target) for path in target.rglob("*") if path.is_file())
    whole, partial = work / "panoramas", work / "some_views"
    prepared, _ = prepare_all(folder, sources, whole)
    for image in prepared:
        if abs(image.width / (2 * image.height) - 1) > MAX_DEVIATION:
            raise DataError(
                f"{folder / image.source} has {image.width}x{image.height} pixels; an equirectangular panorama is "
                "twice as wide as high"
            )
    names = view_names([image.name for image in prepared], len(views.directions))

    def cut_one(index: int) -> None:
        for view in cut(pixels_of(whole / prepared[index].name), panorama_lens(prepared[index]), views):
            path = partial / names[index][view.number]
            path.parent.mkdir(parents=True, exist_ok=True)
            save(Image.fromarray(view.pixels), path)

    in_parallel(cut_one, range(len(prepared)), "Cutting views", len(prepared))
    shutil.rmtree(whole)
    partial.rename(target)
    count = len(prepared) * len(views.directions)
    say(f"{len(prepared)} panoramas are cut into {count} views of {views.angle:g} degrees")
    return target, _in_order(Path(name) for each in names for name in each)


def view_names(names: Sequence[str], count: int, taken: Sequence[str] = ()) -> list[list[str]]:
    """Return names, different from those `taken`, for `count` views of each image in `names`.

    Views of one direction follow each other: every eighth image by name is held out, and of eight views of each image
    that would always be the first, so that no image showed what is ahead.
    """
    views = [Path(name).with_name(f"view_{number}_{Path(name).name}") for name in names for number in range(count)]
    made = output_names([*map(Path, taken), *views])[len(taken) :]
    return [made[start : start + count] for start in range(0, len(made), count)]


def panorama_lens(image: PreparedImage) -> Lens:
    """Return the lens of an equirectangular `image`."""
    width, height = image.width, image.height
    values = {"w": width, "h": height, "fl_x": width / 2, "fl_y": float(height), "cx": width / 2, "cy": height / 2}
    return Lens("EQUIRECTANGULAR", values)


def camera_parameters(side: int, angle: float) -> str:
    """Return COLMAP's fx, fy, cx, cy of a square view of `side` pixels and an `angle` of view in degrees (PINHOLE)."""
    focal = side / 2 / math.tan(math.radians(angle) / 2)
    return f"{focal!r},{focal!r},{side / 2!r},{side / 2!r}"


def _in_order(paths: Iterable[Path]) -> list[Path]:
    return sorted(paths, key=natural_order)


def pixels_of(path: Path) -> np.ndarray:
    """Return the pixels (H, W, 3 or 4) uint8 of the image `path`."""
    with Image.open(path) as opened:
        return np.asarray(opened.convert("RGBA" if "A" in opened.getbands() else "RGB"))
