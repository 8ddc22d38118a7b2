"""The data folder of a capture that another program placed: images, views of panoramas, points and transforms.json."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np
from PIL import Image

from nerfloom.base.console import say
from nerfloom.base.counts import counted
from nerfloom.base.errors import DataError
from nerfloom.base.json_files import write_json
from nerfloom.processing import aria_lens
from nerfloom.processing.capture import Capture, PosedCamera, cropped
from nerfloom.processing.images import PreparedImage, in_parallel, prepare_all, save
from nerfloom.processing.metashape_lens import nearest
from nerfloom.processing.named_images import PlacedImages, reasons
from nerfloom.processing.output import FINISHED, ready
from nerfloom.processing.panoramas import pixels_of, view_names
from nerfloom.processing.pyramid import write_pyramid
from nerfloom.processing.transforms import POINTS, Frame, Lens, content, transformed, write_points
from nerfloom.processing.views import Views, cut, resampled, view_lens

PANORAMA, PERSPECTIVE = "EQUIRECTANGULAR", "OPENCV"
"""Models of lenses."""
ALWAYS_CUT = {aria_lens.MODEL}
"""Models of lenses that transforms.json cannot express."""
VIEWS = Views(8, 90.0)
"""Default views that images of wide lenses are cut into."""


@dataclass(frozen=True)
class _Posed:
    """A prepared image with its pose and its lens."""

    image: PreparedImage
    pose: np.ndarray
    lens: Lens


def write_capture(
    folder: Path,
    capture: Capture,
    placed: PlacedImages,
    output: Path,
    num_downscales: int,
    views: Views = VIEWS,
    whole: bool = False,
    crop: int = 0,
) -> None:
    """Write the data folder of a capture, and report how many of its cameras are in it and why others are not.

    A data folder has one model of lens. If a capture has several, images of wide lenses are cut into perspective views.
    Images of a lens with terms that transforms.json has no place for are resampled to those of the nearest lens.

    Args:
        folder: folder of the photographs.
        placed: the image files of its cameras.
        output: the output folder, claimed by `output.claim`.
        num_downscales: number of folders of reduced images.
        views: views that images of wide lenses are cut into.
        whole: whether panoramas are kept as they are.
        crop: pixels to cut off at each side of the images.

    Raises:
        DataError: if no image can be used, or panoramas cannot be kept because other lenses were used, too.
    """
    # Poses refer to the pixels as they are stored, so images are not turned upright.
    prepared, unreadable = prepare_all(folder, list(placed.cameras), output / "images", upright=False, crop=crop)
    posed, misfits = _with_lenses(prepared, placed.cameras, capture.frame, output / "images", crop)
    spoilt = Counter({"with an unreadable image": len(unreadable), "with an image of another shape": len(misfits)})
    left_out = capture.left_out + placed.left_out + spoilt
    if not posed:
        raise DataError(f"no image of {folder} fits its camera, the first: {misfits[0]}")
    say(f"{capture.program}: {len(posed)} of {capture.total} cameras are placed{_listed(left_out)}")
    if misfits:
        say(f"{len(misfits)} images do not fit their cameras, the first: {misfits[0]}")
    frames = _frames(posed, _models_to_cut({nearest(entry.lens).model for entry in posed}, whole), views, output)
    if capture.points is not None and capture.colors is not None:
        points = capture.points @ capture.frame[:, :3].T + capture.frame[:, 3]
        write_points(output / POINTS, points, capture.colors)
        say(counted(len(points), "points"))
    masks = [frame.mask for frame in frames if frame.mask is not None]
    write_pyramid(output / "images", [frame.name for frame in frames], num_downscales)
    write_pyramid(output / "masks", masks, num_downscales if masks else 0, masks=True)
    more = {"orientation_override": "none"} if capture.z_is_up else {}
    name = None if capture.points is None else POINTS
    write_json(output / FINISHED, content(frames, capture.frame, name, more))
    say(ready(output))


def _with_lenses(
    prepared: Iterable[PreparedImage], placed: dict[Path, PosedCamera], frame: np.ndarray, images: Path, crop: int
) -> tuple[list[_Posed], list[str]]:
    """Return the images with sizes that fit their cameras, and messages about the others, which are removed."""
    posed: list[_Posed] = []
    misfits: list[str] = []
    for image in prepared:
        camera = placed[Path(image.source)]
        try:
            lens = cropped(camera.lens(image.width + 2 * crop, image.height + 2 * crop), crop)
        except DataError as error:
            misfits.append(f"{image.source}: {error}")
            (images / image.name).unlink()
            continue
        posed.append(_Posed(image, transformed(camera.pose, frame), lens))
    return posed, misfits


def _listed(left_out: Counter[str]) -> str:
    return f" (left out: {reasons(left_out)})" if left_out.total() else ""


def _models_to_cut(models: set[str], whole: bool) -> set[str]:
    """Return the models of lenses with images to cut into views, so that one model remains."""
    if whole and PANORAMA in models and len(models) > 1:
        raise DataError("--panoramas whole: there are images of other lenses, too, and a data folder has one model")
    if len(models) == 1:
        return models & (ALWAYS_CUT if whole else {PANORAMA, *ALWAYS_CUT})
    return models - {PERSPECTIVE}


def _frames(posed: list[_Posed], models: set[str], views: Views, output: Path) -> list[Frame]:
    """Return the frames, after cutting the images of some models of lenses."""
    kept = [entry for entry in posed if nearest(entry.lens).model not in models]
    wide = [entry for entry in posed if nearest(entry.lens).model in models]
    frames = _straightened(kept, output)
    if not wide:
        return frames
    taken = [entry.image.name for entry in posed]
    names = view_names([entry.image.name for entry in wide], len(views.directions), taken)

    def cut_one(index: int) -> list[Frame]:
        return _cut(wide[index], names[index], views, output)

    made = list(chain.from_iterable(in_parallel(cut_one, range(len(wide)), "Cutting views", len(wide))))
    if not made:
        raise DataError("no view shows enough of its image; use a smaller --view-angle")
    say(f"{len(wide)} images of wide lenses are cut into {len(made)} views of {views.angle:g} degrees")
    return [*frames, *made]


def _straightened(entries: list[_Posed], output: Path) -> list[Frame]:
    """Return the frames of images that stay as they are, but for those of lenses that transforms.json cannot express.

    Such images are replaced by what the nearest lens would have taken.
    """
    bent = [entry for entry in entries if nearest(entry.lens) is not entry.lens]

    def straighten(entry: _Posed) -> str | None:
        image = pixels_of(output / "images" / entry.image.name)
        pixels, seen = resampled(image, entry.lens, nearest(entry.lens), np.eye(3))
        return _save_with_mask(pixels, seen, entry.image.name, output)

    made = in_parallel(straighten, bent, "Straightening images", len(bent)) if bent else []
    masks = {entry.image.name: mask for entry, mask in zip(bent, made, strict=True)}
    if bent:
        say(f"{len(bent)} images are resampled, because transforms.json has no place for all terms of their lens")
    return [
        Frame(e.image.name, e.pose, nearest(e.lens), masks.get(e.image.name), source=e.image.source) for e in entries
    ]


def _cut(entry: _Posed, names: list[str], views: Views, output: Path) -> list[Frame]:
    """Write the views of an image, with masks where they reach beyond it, and remove the image."""
    path = output / "images" / entry.image.name
    lens = view_lens(entry.lens, views.angle)
    frames = []
    for view in cut(pixels_of(path), entry.lens, views):
        name, pose = names[view.number], entry.pose.copy()
        pose[:3, :3] = entry.pose[:3, :3] @ view.rotation
        mask = _save_with_mask(view.pixels, view.seen, name, output)
        frames.append(Frame(name, pose, lens, mask, source=entry.image.source))
    path.unlink()
    return frames


def _save_with_mask(pixels: np.ndarray, seen: np.ndarray, name: str, output: Path) -> str | None:
    """Write an image, and a mask if some of its pixels were not `seen`; return the mask's name, or None."""
    save(Image.fromarray(pixels), output / "images" / name)
    if seen.all():
        return None
    target = output / "masks" / f"{name}.png"
    target.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.where(seen, 255, 0).astype(np.uint8)).save(target)
    return f"{name}.png"
