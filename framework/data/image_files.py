"""Image files: what is in their headers, and their pixels, reduced by a whole number."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from pathlib import Path

import imageio.v3 as iio
import numpy as np
from PIL import EpsImagePlugin, Image, UnidentifiedImageError

from framework.base.errors import DataError

# A file is read as what it holds, whatever its name; PostScript is a program, which Ghostscript would run.
EpsImagePlugin.gs_binary = False

LARGEST_FILE = 2**30
"""Bytes of an image file."""
BAND = 64
"""Rows of a reduced image that are made at once: float64 takes eight times the memory of the pixels it is made from."""


def image_size(paths: Sequence[Path]) -> tuple[int, int]:
    """Width and height of the first of some image files that can be read, from its header.

    Raises: DataError where none can be read.
    """
    reason = ""
    for path in paths:
        try:
            height, width = iio.improps(path, plugin="pillow", index=0).shape[:2]  # of an animation its first picture
            if width and height:
                return width, height
            reason = reason or f"{path} has no pixel"
        except Exception as error:  # whatever the decoder raises, as in `read_image`
            reason = reason or str(unreadable(path, error))
    raise DataError(reason or "there is no image to read a size from")


class Content(io.BytesIO):
    """All that an image file holds: of an open file, Pillow asks for as many bytes as a chunk claims to have.

    Raises: OSError where it cannot be read; DataError where it is too large to be an image.
    """

    def __init__(self, path: Path) -> None:
        if (size := path.stat().st_size) > LARGEST_FILE:
            raise DataError(f"{path} has {size / 1e9:.1f} GB, and is no image that is read")
        super().__init__(path.read_bytes())
        self.path = path

    def __repr__(self) -> str:
        return f"'{self.path}'"  # as Pillow's messages have it


def read_image(path: Path, factor: int = 1) -> np.ndarray:
    """An 8-bit image as (H, W, 4) uint8 with straight alpha, reduced by a whole number; of several the first.

    Raises: DataError where it cannot be decoded or has more than 8 bits a channel.
    """
    try:
        mode = str(iio.immeta(path, plugin="pillow", index=0).get("mode", ""))
        if mode.startswith(("I", "F")) or _is_deep_png(path):
            raise DataError(f"{path} has more than 8 bits a channel; convert it to an 8-bit PNG")
        image = np.asarray(iio.imread(Content(path), plugin="pillow", mode="RGBA", index=0))
    except DataError:
        raise
    except Exception as error:  # Pillow raises OSError, SyntaxError, struct.error, DecompressionBombError and more
        raise unreadable(path, error) from error
    return image if factor == 1 else reduce_image(image, factor)


def _is_deep_png(path: Path) -> bool:
    """Whether a PNG has 16 bits a channel, which Pillow would cut to 8 without a word (bit depth: byte 24)."""
    with path.open("rb") as file:
        head = file.read(25)
    return head[:8] == b"\x89PNG\r\n\x1a\n" and head[24:] == b"\x10"


def reduce_image(image: np.ndarray, factor: int) -> np.ndarray:
    """Box filter by a whole number: (H, W, 4) uint8 to (H // factor, W // factor, 4).

    Colours are averaged weighted by alpha, so that transparent pixels lend none of theirs.
    """
    height, width = image.shape[0] // factor, image.shape[1] // factor
    if height == 0 or width == 0:
        size = f"{image.shape[1]}x{image.shape[0]}"
        raise DataError(f"an image of {size} pixels has none left at --downscale-factor {factor}")
    out = np.empty((height, width, 4), np.uint8)
    for top in range(0, height, BAND):
        band = image[top * factor : min(top + BAND, height) * factor, : width * factor]
        blocks = band.reshape(-1, factor, width, factor, 4).astype(np.float64)
        alpha = blocks[..., 3:].sum((1, 3))
        color = (blocks[..., :3] * blocks[..., 3:]).sum((1, 3)) / np.maximum(alpha, 1)
        out[top : top + BAND, :, :3], out[top : top + BAND, :, 3:] = color.round(), (alpha / factor**2).round()
    return out


def may_be_transparent(path: Path) -> bool:
    """Whether a file's header leaves room for alpha. A file whose header cannot be read has none."""
    try:
        meta = iio.immeta(path, plugin="pillow", index=0)
    except Exception:  # whatever the decoder raises; the file is reported when it is decoded
        return False
    return "A" in str(meta.get("mode", "")).upper() or "transparency" in meta


def unreadable(path: Path, error: BaseException, what: str = "") -> DataError:
    """The error of a file that no decoder reads, in words that say what to do, for decoders' own are not for users.

    Args:
        error: whatever the decoder raised.
        what: to call the file, as in "the mask".
    """
    name = f"{what} {path}".lstrip()
    try:
        size = path.stat().st_size
    except OSError:
        size = -1
    unknown = any(isinstance(one, UnidentifiedImageError) for one in _chain(error))
    if isinstance(error, OSError) and error.errno is not None:
        reason = f"{error.strerror}"
    elif isinstance(error, DataError):
        reason = str(error)
    elif size == 0:
        reason = "the file is empty; copy it again"
    elif unknown and path.suffix.lower() in (".heic", ".heif"):
        reason = "HEIC needs another package: pip install pillow-heif"
    elif unknown:
        reason = "what it holds is no image, or its beginning is damaged; copy it again"
    elif isinstance(error, Image.DecompressionBombError):
        reason = "it has more pixels than are read; reduce it"
    else:
        reason = "it is damaged or cut short; copy it again"
    return DataError(f"{name} is not a readable image: {reason}")


def _chain(error: BaseException | None) -> Iterator[BaseException]:
    """An error, and those that it was raised from or over."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def one_line(error: BaseException) -> str:
    """The first line of an error's message, or its type's name."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
