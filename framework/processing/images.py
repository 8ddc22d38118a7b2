"""Preparation of images: upright, 8 bits per channel, RGB or RGBA, JPEG or PNG."""

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

from nerfloom.base.console import say, track
from nerfloom.base.errors import DataError
from nerfloom.data.image_files import Content, read_heif, unreadable
from nerfloom.data.masks import read_white
from nerfloom.data.names_on_disk import companions_of, files_below
from nerfloom.processing.brightness import eight_bits, tones
from nerfloom.processing.listing import READABLE

_JPEG = (".jpg", ".jpeg")
_ORIENTATION = 0x0112
OPERATIONS = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
"""EXIF orientation -> operation that makes the image upright."""
T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True)
class PreparedImage:
    """An image after preparation."""

    name: str
    """Path in the output's images folder, with '/'."""
    source: str
    """Path in the input folder, with '/'."""
    width: int
    """Width after preparation, pixels."""
    height: int
    """Height after preparation, pixels."""
    device: tuple
    """Maker, model and focal lengths (mm) from EXIF; equal for images of one camera."""
    orientation: int
    """EXIF orientation that was undone; 1 for none."""
    tones: tuple[float, float]
    """Ends of the range of brightness in the source, from 0 to 1 (`brightness.tones`)."""


def output_names(sources: Iterable[Path]) -> list[str]:
    """Return distinct names for the output's images folder, without white space and with a lower-case suffix.

    COLMAP separates names in lists of pairs by white space, and takes a line that begins with # for a comment. Some
    file systems do not distinguish A.jpg from a.jpg. Images other than JPEG become .png.

    Args:
        sources: paths of the images in the input folder.
    """
    taken: set[str] = set()
    names = []
    for source in sources:
        ending = source.suffix.lower() if source.suffix.lower() in _JPEG else ".png"
        stem = re.sub(r"\s|^#", "_", source.with_suffix("").as_posix())
        name, count = stem + ending, 1
        while name.lower() in taken:
            count += 1
            name = f"{stem}_{count}{ending}"
        taken.add(name.lower())
        names.append(name)
    return names


def prepare_all(
    folder: Path, sources: list[Path], images: Path, upright: bool = True, crop: int = 0
) -> tuple[list[PreparedImage], list[str]]:
    """Prepare images in parallel, and report how many are unreadable and why the first is.

    Args:
        folder: folder of the sources.
        sources: paths of the images in it.
        images: folder to write to.
        upright: whether to undo the EXIF orientation.
        crop: pixels to cut off at each side.

    Returns:
        The prepared images in order, and the error messages for unreadable files, which are left out.

    Raises:
        DataError: if no image is readable.
    """
    names = output_names(sources)

    def attempt(index: int) -> PreparedImage | str:
        try:
            return prepare(folder, sources[index], images, names[index], upright, crop)
        except DataError as error:
            return str(error)

    results = in_parallel(attempt, range(len(sources)), "Preparing images", len(sources))
    prepared = [result for result in results if isinstance(result, PreparedImage)]
    messages = [result for result in results if isinstance(result, str)]
    if messages:
        say(f"{len(messages)} of {len(sources)} images are unreadable and skipped, the first: {messages[0]}")
    if not prepared:
        raise DataError(f"{folder} has no readable image: {messages[0]}")
    return prepared, messages


def prepare(folder: Path, source: Path, images: Path, name: str, upright: bool = True, crop: int = 0) -> PreparedImage:
    """Prepare one image; a file that needs no change is copied.

    Args:
        folder: folder of the source.
        source: path of the image in it.
        images: folder to write to.
        name: path of the result in it.
        upright: whether to undo the EXIF orientation; False if poses refer to the stored pixels.
        crop: pixels to cut off at each side.

    Raises:
        DataError: if the image cannot be decoded completely.
    """
    path, target = folder / source, images / name
    target.parent.mkdir(parents=True, exist_ok=True)
    read_heif()
    try:
        with Image.open(Content(path)) as image:
            image.load()  # a truncated file fails here
            exif = image.getexif()
            orientation = exif.get(_ORIENTATION, 1)
            operation = OPERATIONS.get(orientation) if upright else None
            device, ends = _device(exif), tones(image)
            if orientation == 1 and not crop and _is_uniform(image, path, target.suffix):
                shutil.copyfile(path, target)
                size = image.size
            else:
                exif.pop(_ORIENTATION, None)
                result = eight_bits(image) if operation is None else eight_bits(image).transpose(operation)
                result = _cropped(result, crop)
                options = {"exif": exif.tobytes(), "icc_profile": _profile(image)}
                save(result, target, {key: value for key, value in options.items() if value})
                size = result.size
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):  # a full disk is not the image's fault
            raise
        raise unreadable(path, error) from error
    except Exception as error:  # Pillow raises SyntaxError, struct.error, DecompressionBombError and more
        raise unreadable(path, error) from error
    return PreparedImage(name, source.as_posix(), *size, device, orientation if operation is not None else 1, ends)


def save(image: Image.Image, path: Path, options: dict[str, Any] | None = None) -> None:
    """Write a JPEG of high quality, without alpha, or a PNG, by the suffix of `path`, with further Pillow `options`."""
    if path.suffix in _JPEG:
        image.convert("RGB").save(path, format="JPEG", quality=95, subsampling=0, **(options or {}))
    else:
        image.save(path, format="PNG", **(options or {}))


def write_masks(folder: Path, prepared: list[PreparedImage], masks: Path) -> dict[str, str]:
    """Write the masks of prepared images as 0 or 255, upright like them, named as in COLMAP: image.jpg.png.

    Args:
        folder: folder of masks, named like the images, with an additional or another ending.
        prepared: the prepared images.
        masks: folder to write to.

    Returns:
        The path in `masks` of each mask, by the name of its image.

    Raises:
        DataError: if no mask is found, or one differs in size from its image.
    """
    mask_names = {}
    files = [file for file in files_below(folder, READABLE) if (folder / file).is_file()]
    for entry, file in zip(prepared, companions_of([entry.source for entry in prepared], files), strict=True):
        if file is None:
            continue
        mask = Image.fromarray(np.where(read_white(folder / file), 255, 0).astype(np.uint8))
        size = (entry.width, entry.height)
        is_upright = entry.orientation >= 5 and mask.size == size and size[0] != size[1]
        if entry.orientation in OPERATIONS and not is_upright:
            mask = mask.transpose(OPERATIONS[entry.orientation])
        if mask.size != size:
            raise DataError(f"the mask {folder / file} differs in size from its image {entry.source}")
        target = masks / f"{entry.name}.png"
        target.parent.mkdir(parents=True, exist_ok=True)
        mask.save(target)
        mask_names[entry.name] = f"{entry.name}.png"
    if not mask_names:
        first = PurePosixPath(prepared[0].source).with_suffix(".png")
        raise DataError(f"--masks-dir {folder} has no mask; the first expected is {first}")
    without = [entry.source for entry in prepared if entry.name not in mask_names]
    if without:
        say(f"{len(without)} of {len(prepared)} images have no mask, the first {without[0]}")
    return mask_names


def in_parallel(work: Callable[[T], R], items: Iterable[T], title: str, total: int) -> list[R]:
    """Apply `work` to all `items` in threads, with a bar of `title` and `total`; interrupts cancel the rest."""
    pool = ThreadPoolExecutor()
    try:
        return list(track(pool.map(work, items), title, total=total))
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _cropped(image: Image.Image, crop: int) -> Image.Image:
    if not crop:
        return image
    width, height = image.size
    if min(width, height) <= 2 * crop:
        raise DataError(f"an image of {width}x{height} pixels has no pixels left after cropping {crop} at each side")
    return image.crop((crop, crop, width - crop, height - crop))


def _profile(image: Image.Image) -> bytes:
    """Return the colour profile of an image after its conversion to RGB; empty if it has none, or one of other colours.

    Bytes 16 to 19 of a profile name the colours that it describes (ICC.1:2022, 7.2).
    """
    profile: bytes = image.info.get("icc_profile") or b""
    return profile if profile[16:20] == b"RGB " else b""


def _is_uniform(image: Image.Image, path: Path, ending: str) -> bool:
    if image.format in ("JPEG", "MPO"):
        return ending in _JPEG and image.mode == "RGB"
    if image.format != "PNG" or ending != ".png" or image.mode not in ("RGB", "RGBA") or "transparency" in image.info:
        return False
    with path.open("rb") as file:
        return file.read(25)[24:] == b"\x08"  # Pillow does not report 16 bits per channel


def _device(exif: Image.Exif) -> tuple:
    """Return maker, model, focal length and focal length in 35 mm film; None if missing."""
    details = exif.get_ifd(0x8769)
    return (*(str(exif.get(tag)) for tag in (0x010F, 0x0110)), *(str(details.get(tag)) for tag in (0x920A, 0xA405)))
