"""Image files: their headers, and their pixels, reduced by an integer factor."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TypeVar

import imageio.v3 as iio
import numpy as np
from PIL import EpsImagePlugin, Image, UnidentifiedImageError, features

from nerfloom.base.errors import DataError
from nerfloom.base.extras import install_command
from nerfloom.base.lfs import ADVICE, is_pointer
from nerfloom.data.suffixes import HEIF_SUFFIXES, UNREAD_SUFFIXES

# Pillow detects the format from the content, not from the name, and would run Ghostscript, an interpreter, for EPS.
EpsImagePlugin.gs_binary = False

T = TypeVar("T")
MAX_FILE = 2**30
"""Maximum size of an image file, bytes."""
BAND = 64
"""Number of rows of a reduced image computed at once: float64 takes eight times the memory of the source pixels."""


def read_heif() -> None:
    """Let Pillow read HEIC from now on, whatever files are called, if the package pillow-heif is installed."""
    if install_command("heic") is None:
        from pillow_heif import register_heif_opener

        register_heif_opener()


def image_size(paths: Sequence[Path]) -> tuple[int, int]:
    """Return width and height, in pixels, of the first readable image of `paths`, from its header.

    Raises:
        DataError: if no file is readable.
    """
    reason = ""
    for path in paths:
        read_heif()
        try:
            height, width = iio.improps(path, plugin="pillow", index=0).shape[:2]  # the first frame of an animation
            if width and height:
                return width, height
            reason = reason or f"{path} has no pixels"
        except Exception as error:  # any type, as in `read_image`
            reason = reason or str(unreadable(path, error))
    raise DataError(reason or "there are no images")


class Content(io.BytesIO):
    """The whole content of an image file. With an open file, Pillow would allocate the bytes that a chunk claims.

    Raises:
        OSError: if the file cannot be read.
        DataError: if it is too large to be an image.
    """

    def __init__(self, path: Path) -> None:
        if (size := path.stat().st_size) > MAX_FILE:
            raise DataError(f"{path} has {size / 1e9:.1f} GB; the limit for images is 1 GB")
        super().__init__(path.read_bytes())
        self.path = path

    def __repr__(self) -> str:
        return f"'{self.path}'"  # for Pillow's messages


def read_image(path: Path, factor: int = 1) -> np.ndarray:
    """Read an 8-bit image, `path`, reduced by `factor`, as (H, W, 4) uint8, straight alpha; the first frame.

    Raises:
        DataError: if the image cannot be decoded, or has more than 8 bits per channel.
    """
    read_heif()
    try:
        content = Content(path)
        deep = _is_deep_png(content)
        with Image.open(content) as opened:
            if deep or opened.mode.startswith(("I", "F")):
                raise DataError(f"{path} has more than 8 bits per channel; convert it to an 8-bit PNG")
            image = np.array(opened.convert("RGBA"))
    except DataError:
        raise
    except Exception as error:  # Pillow raises OSError, SyntaxError, struct.error, DecompressionBombError and more
        raise unreadable(path, error) from error
    return image if factor == 1 else reduce_image(image, factor)


def _is_deep_png(content: Content) -> bool:
    """Return whether a PNG has 16 bits per channel, which Pillow would silently reduce to 8 (bit depth: byte 24)."""
    head = content.read(25)
    content.seek(0)
    return head[:8] == b"\x89PNG\r\n\x1a\n" and head[24:] == b"\x10"


def reduce_image(image: np.ndarray, factor: int) -> np.ndarray:
    """Reduce an image by an integer factor with a box filter.

    Colours are weighted by alpha, so that transparent pixels do not contribute.

    Args:
        image: (H, W, 4) uint8 with straight alpha.
        factor: side of a block of pixels that becomes one pixel.

    Returns:
        (H // factor, W // factor, 4) uint8.

    Raises:
        DataError: if no pixels remain.
    """
    height, width = image.shape[0] // factor, image.shape[1] // factor
    if height == 0 or width == 0:
        size = f"{image.shape[1]}x{image.shape[0]}"
        raise DataError(f"an image of {size} pixels has none left at --downscale-factor {factor}; use a smaller factor")
    out = np.empty((height, width, 4), np.uint8)
    for top in range(0, height, BAND):
        band = image[top * factor : min(top + BAND, height) * factor, : width * factor]
        blocks = band.reshape(-1, factor, width, factor, 4).astype(np.float64)
        alpha = blocks[..., 3:].sum((1, 3))
        color = (blocks[..., :3] * blocks[..., 3:]).sum((1, 3)) / np.maximum(alpha, 1)
        out[top : top + BAND, :, :3], out[top : top + BAND, :, 3:] = color.round(), (alpha / factor**2).round()
    return out


def may_be_transparent(path: Path) -> bool:
    """Return whether the header of an image allows for alpha; False if the header of `path` cannot be read."""
    read_heif()
    try:
        with Image.open(path) as image:  # `iio.immeta` would decode a PNG, to look for EXIF behind the pixels
            return "A" in image.mode.upper() or "transparency" in image.info
    except Exception:  # any type; the file is reported when it is decoded
        return False


def unreadable(path: Path, error: BaseException, what: str = "") -> DataError:
    """Return the error for an unreadable image, `what` in the message, at `path`, with advice for `error`."""
    name = f"{what} {path}".lstrip()
    try:
        size = path.stat().st_size
    except OSError:
        size = -1
    unidentified = any(isinstance(cause, UnidentifiedImageError) for cause in _chain(error))
    if isinstance(error, OSError) and error.errno is not None:
        reason = f"{error.strerror}"
    elif isinstance(error, DataError):
        reason = str(error)
    elif size == 0:
        reason = "the file is empty; copy it again"
    elif is_pointer(path):
        reason = ADVICE
    elif unidentified and path.suffix.lower() in HEIF_SUFFIXES and (command := install_command("heic")):
        reason = f"HEIC needs another package: {command}"
    elif unidentified and path.suffix.lower() == ".avif" and not features.check("avif"):
        reason = "AVIF needs Pillow 11.3 or later, built with it: pip install --upgrade pillow"
    elif unidentified and path.suffix.lower() in UNREAD_SUFFIXES:
        reason = f"{path.suffix} files are not supported; convert it to PNG or JPEG"
    elif unidentified:
        reason = "it is not an image, or its beginning is damaged; copy it again"
    elif isinstance(error, Image.DecompressionBombError):
        reason = "it has too many pixels; reduce it"
    else:
        reason = "it is damaged or truncated; copy it again"
    return DataError(f"{name} is not a readable image: {reason}")


def or_unreadable(path: Path, what: str, read: Callable[[], T]) -> T:
    """Return what `read` returns; any error becomes the one of the unreadable image `path`, `what` in the message."""
    try:
        return read()
    except Exception as error:  # decoders raise errors of many kinds
        raise unreadable(path, error, what) from error


def _chain(error: BaseException | None) -> Iterator[BaseException]:
    """Yield an error and the errors that caused it."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__
