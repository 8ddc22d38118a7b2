"""Photographs as they come, made uniform: upright, 8 bits a channel, RGB or RGBA, JPEG or PNG."""

from __future__ import annotations

import errno
import re
import shutil
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar

import numpy as np
from PIL import Image

from framework.base.console import say, track
from framework.base.errors import DataError
from framework.data.data_folder import IMAGE_SUFFIXES
from framework.data.image_files import Content, unreadable

_JPEG = (".jpg", ".jpeg")
_ORIENTATION = 0x0112
_TURNS = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
"""What makes an image upright that has this EXIF orientation."""
T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True)
class Photograph:
    """A photograph that has been made uniform."""

    name: str
    """Its path in the output's images folder, with '/'."""
    source: str
    """Its path in the input folder, with '/'."""
    width: int
    height: int
    device: tuple
    """Maker, model and focal lengths (mm) as EXIF says: what one camera's photographs have in common."""
    orientation: int
    """EXIF orientation that was undone, 1 for none."""


def find_photographs(folder: Path, leave_out: Iterable[Path] = ()) -> list[Path]:
    """Paths of the image files in a folder and below, relative to it; 'img2' comes before 'img10'.

    Hidden files, and what is in the folders `leave_out` that are below it, are not looked at.

    Raises: DataError where the folder does not exist or has no image.
    """
    if not folder.is_dir():
        raise DataError(f"--data {folder}: there is no such folder")
    others = [path.resolve() for path in leave_out if not folder.resolve().is_relative_to(path.resolve())]
    found = []
    for path in folder.rglob("*"):
        relative = path.relative_to(folder)
        if path.suffix.lower() not in IMAGE_SUFFIXES or any(part.startswith(".") for part in relative.parts):
            continue
        if path.is_file() and not any(path.resolve().is_relative_to(other) for other in others):
            found.append(relative)
    if not found:
        raise DataError(f"--data {folder} has no image (looked for {', '.join(IMAGE_SUFFIXES)})")
    return sorted(found, key=natural_order)


def natural_order(path: Path) -> list[tuple[int, int, str]]:
    """A sorting key by which numbers in a name count as numbers."""
    parts = re.split(r"(\d+)", path.as_posix().lower())
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts if part]


def output_names(sources: Iterable[Path]) -> list[str]:
    """Names in the output's images folder: no white space, lower-case ending, .png for what is no JPEG, all different.

    COLMAP separates the names in lists of pairs by white space, and some file systems do not tell A.jpg from a.jpg.
    """
    taken: set[str] = set()
    names = []
    for source in sources:
        ending = source.suffix.lower() if source.suffix.lower() in _JPEG else ".png"
        stem = re.sub(r"\s", "_", source.with_suffix("").as_posix())
        name, count = stem + ending, 1
        while name.lower() in taken:
            count += 1
            name = f"{stem}_{count}{ending}"
        taken.add(name.lower())
        names.append(name)
    return names


def prepare_all(
    folder: Path, sources: list[Path], images: Path, upright: bool = True, crop: int = 0
) -> tuple[list[Photograph], list[str]]:
    """Make photographs uniform, in their order.

    Args:
        folder: where the sources are.
        images: the folder to write into.
        upright, crop: as in `prepare`.
    Returns: the photographs, and for each unreadable file (left out) a line that says why.
    """
    names = output_names(sources)
    register_heif()

    def attempt(index: int) -> Photograph | str:
        try:
            return prepare(folder, sources[index], images, names[index], upright, crop)
        except DataError as error:
            return str(error)

    results = in_parallel(attempt, range(len(sources)), "Preparing images", len(sources))
    return [r for r in results if isinstance(r, Photograph)], [r for r in results if isinstance(r, str)]


def prepare(folder: Path, source: Path, images: Path, name: str, upright: bool = True, crop: int = 0) -> Photograph:
    """Make one photograph uniform; a file that is so already is copied without a change.

    Args:
        upright: undo the EXIF orientation; False where poses belong to the pixels as stored.
        crop: pixels to cut off at each side.
    Raises: DataError where it cannot be decoded in full.
    """
    path, target = folder / source, images / name
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        with Image.open(Content(path)) as image:
            image.load()  # a file that was cut short fails here
            exif = image.getexif()
            orientation = exif.get(_ORIENTATION, 1)
            turn = _TURNS.get(orientation) if upright else None
            device = _device(exif)
            if orientation == 1 and not crop and _is_uniform(image, path, target.suffix):
                shutil.copyfile(path, target)
                size = image.size
            else:
                exif.pop(_ORIENTATION, None)
                turned = eight_bits(image) if turn is None else eight_bits(image).transpose(turn)
                turned = _cropped(turned, crop)
                options = {"exif": exif.tobytes(), "icc_profile": image.info.get("icc_profile")}
                save(turned, target, {key: value for key, value in options.items() if value})
                size = turned.size
    except DataError:
        raise
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):  # a full disk is no bad photograph
            raise
        raise unreadable(path, error) from error
    except Exception as error:  # Pillow raises SyntaxError, struct.error, DecompressionBombError and more
        raise unreadable(path, error) from error
    return Photograph(name, source.as_posix(), *size, device, orientation if turn is not None else 1)


def eight_bits(image: Image.Image) -> Image.Image:
    """An image of any mode as RGB, or RGBA where something is transparent.

    Raises: DataError for floating-point images, whose white is not known.
    """
    if image.mode == "F":
        raise DataError("floating-point pixels; convert it to an 8-bit PNG")
    if image.mode.startswith("I"):  # 16 bits of grey
        deep = np.asarray(image).astype(np.float64)
        return Image.fromarray((deep / 257).round().clip(0, 255).astype(np.uint8)).convert("RGB")
    if image.mode in ("RGBA", "LA", "PA", "La", "RGBa") or "transparency" in image.info:
        rgba = image.convert("RGBA")
        return rgba if (np.asarray(rgba)[..., 3] < 255).any() else rgba.convert("RGB")
    return image.convert("RGB")


def save(image: Image.Image, path: Path, options: dict[str, Any] | None = None) -> None:
    """Write a JPEG of high quality (what is transparent is lost) or a PNG, as the ending says."""
    if path.suffix in _JPEG:
        image.convert("RGB").save(path, format="JPEG", quality=95, subsampling=0, **(options or {}))
    else:
        image.save(path, format="PNG", **(options or {}))


def write_masks(folder: Path, photographs: list[Photograph], masks: Path, crop: int = 0) -> dict[str, str]:
    """Masks of photographs as 0 or 255, upright as they are, named as COLMAP expects: photograph.jpg.png.

    Args:
        folder: masks under the photographs' names (with their ending, .png instead of it, or .png after it).
    Returns: the mask's path in `masks` of each photograph that has one, by the photograph's name.
    Raises: DataError where no mask is found, or one has not its photograph's size.
    """
    found = {}
    for photograph in photographs:
        source = PurePosixPath(photograph.source)
        candidates = [source, source.with_suffix(".png"), source.with_suffix(".PNG"), PurePosixPath(f"{source}.png")]
        path = next((folder / one for one in candidates if (folder / one).is_file()), None)
        if path is None:
            continue
        try:
            with Image.open(Content(path)) as image:
                mask = image.convert("L").point(lambda value: 255 if value >= 128 else 0)
        except Exception as error:
            raise unreadable(path, error, "the mask") from error
        size = (photograph.width + 2 * crop, photograph.height + 2 * crop)
        is_upright = photograph.orientation >= 5 and mask.size == size and size[0] != size[1]
        if photograph.orientation in _TURNS and not is_upright:
            mask = mask.transpose(_TURNS[photograph.orientation])
        if mask.size != size:
            raise DataError(f"the mask {path} has not the size of its photograph {photograph.source}")
        mask = _cropped(mask, crop)
        target = masks / f"{photograph.name}.png"
        target.parent.mkdir(parents=True, exist_ok=True)
        mask.save(target)
        found[photograph.name] = f"{photograph.name}.png"
    if not found:
        raise DataError(f"--masks-dir {folder} has no mask; the first would be {candidates[1] if photographs else ''}")
    if len(found) < len(photographs):
        say(f"{len(photographs) - len(found)} of {len(photographs)} photographs have no mask")
    return found


def in_parallel(work: Callable[[T], R], items: Iterable[T], title: str, total: int) -> list[R]:
    """`work` on every item in threads, with a progress bar; an interruption drops what has not begun."""
    pool = ThreadPoolExecutor()
    try:
        return list(track(pool.map(work, items), title, total=total))
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def register_heif() -> None:
    """Let Pillow read HEIC where the package pillow-heif is installed."""
    try:
        import pillow_heif  # type: ignore[import-not-found,unused-ignore]
    except ImportError:
        return
    pillow_heif.register_heif_opener()


def _cropped(image: Image.Image, crop: int) -> Image.Image:
    if not crop:
        return image
    width, height = image.size
    if min(width, height) <= 2 * crop:
        raise DataError(f"an image of {width}x{height} pixels has none left without {crop} at each side")
    return image.crop((crop, crop, width - crop, height - crop))


def _is_uniform(image: Image.Image, path: Path, ending: str) -> bool:
    if image.format in ("JPEG", "MPO"):
        return ending in _JPEG and image.mode == "RGB"
    if image.format != "PNG" or ending != ".png" or image.mode not in ("RGB", "RGBA") or "transparency" in image.info:
        return False
    with path.open("rb") as file:
        return file.read(25)[24:] == b"\x08"  # Pillow does not tell a PNG of 16 bits a channel


def _device(exif: Image.Exif) -> tuple:
    """Maker, model, focal length, focal length as on 35 mm film; None where not told."""
    details = exif.get_ifd(0x8769)
    return (*(str(exif.get(tag)) for tag in (0x010F, 0x0110)), *(str(details.get(tag)) for tag in (0x920A, 0xA405)))
